/* What a stream measures of a body with every frame. What the numbers mean, and the tables that are
   handed in, are in app/domain/body.py; the same is there in numpy. */

enum { AXES = 3, FACTS = 4 };
/* Rows of the table: what points forwards, then lines between joints. */
enum { SHOULDERS = 6, HIPS, SPINE, HEAD, TO_SHOULDERS, TO_HIPS, LINES };

static double measure_length(const double *v) { return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

static double clamp(double value, double low, double high) { return value < low ? low : value > high ? high : value; }

static void measure_pose(
    const double *pose, int joints, const double *table, const double *weights, double limit, double *facts) {
    double rows[LINES][AXES] = {{0}}, wide[AXES], front[AXES], facing = 0.0;
    for (int i = 0; i < LINES; i++)
        for (int j = 0; j < joints; j++)
            for (int k = 0; k < AXES; k++) rows[i][k] += table[i * joints + j] * pose[AXES * j + k];
    const double *spine = rows[SPINE], torso = measure_length(spine);
    const double shoulders = fmax(measure_length(rows[SHOULDERS]), 0.05), hips = fmax(measure_length(rows[HIPS]), 0.05);
    for (int k = 0; k < AXES; k++) wide[k] = rows[SHOULDERS][k] / shoulders + rows[HIPS][k] / hips;
    for (int k = 0; k < AXES; k++) {
        const int next = (k + 1) % AXES, last = (k + 2) % AXES;
        front[k] = wide[next] * spine[last] - wide[last] * spine[next];
    }
    const double scale = fmax(measure_length(front), 1e-6) * fmax(torso, 0.1);
    for (int i = 0; i < SHOULDERS; i++) {
        const double cue = rows[i][0] * front[0] + rows[i][1] * front[1] + rows[i][2] * front[2];
        facing += weights[i] * clamp(cue / scale, -limit, limit);
    }
    facts[0] = torso, facts[1] = rows[HEAD][1], facts[2] = facing;
    facts[3] = measure_length(rows[TO_SHOULDERS]) - measure_length(rows[TO_HIPS]);
}

PyDoc_STRVAR(measure_doc,
    "measure_body(pose, table, weights, limit, facts, row)\n--\n\n"
    "Fill a row of `facts` with what is measured of a pose. pose: [joints, 3]; table: [12, joints];\n"
    "weights: [6]; facts: [n, 4]; all are float64.");

static PyObject *measure_body(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer pose, table, weights, facts;
    double limit;
    Py_ssize_t row;
    if (!PyArg_ParseTuple(args, "y*y*y*dw*n", &pose, &table, &weights, &limit, &facts, &row)) return NULL;
    const Py_ssize_t number = sizeof(double), joints = pose.len / (AXES * number), width = FACTS * number;
    const int fits = joints * AXES * number == pose.len && table.len == LINES * joints * number &&
                     weights.len == SHOULDERS * number && row >= 0 && row < facts.len / width;
    if (fits) measure_pose(pose.buf, (int)joints, table.buf, weights.buf, limit, (double *)facts.buf + FACTS * row);
    else PyErr_SetString(PyExc_ValueError, "arrays of sizes that do not fit each other");
    PyBuffer_Release(&pose), PyBuffer_Release(&table), PyBuffer_Release(&weights), PyBuffer_Release(&facts);
    return fits ? Py_NewRef(Py_None) : NULL;
}

PyDoc_STRVAR(within_doc,
    "is_within(numbers, limit)\n--\n\nTell whether all of some float64 numbers, at least one, lie within ±limit.");

static PyObject *is_within(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer numbers;
    double limit;
    if (!PyArg_ParseTuple(args, "y*d", &numbers, &limit)) return NULL;
    const double *number = numbers.buf;
    const Py_ssize_t count = numbers.len / (Py_ssize_t)sizeof(double);
    int holds = count > 0;
    for (Py_ssize_t i = 0; i < count; i++) holds &= fabs(number[i]) <= limit; /* not for NaN */
    PyBuffer_Release(&numbers);
    return PyBool_FromLong(holds);
}
