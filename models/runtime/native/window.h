/* What a stream does with every frame: the window on its grid, and how fast it moves. */

/* Put frames at any times on a grid of times before the newest frame, by lines between neighbours.

   `times` increase; a grid point within `snap` of a frame is that frame, one before the oldest frame
   holds its pose. Gives the longest step between the frames that the window spans. */
static double resample_frames(
    const double *times, const double *poses, int frames, int width, const double *grid, int points,
    double snap, double *out) {
    const double newest = times[frames - 1];
    int left = 0, oldest = 0;
    for (int i = 0; i < points; i++, out += width) {
        while (left + 1 < frames && times[left + 1] - newest <= grid[i] + snap) left++;
        if (i == 0) oldest = left;
        const double past = grid[i] - (times[left] - newest);
        const double *from = poses + (size_t)left * width;
        if (past <= snap || left + 1 == frames) {
            memcpy(out, from, width * sizeof(double));
            continue;
        }
        const double share = past / (times[left + 1] - times[left]);
        for (int k = 0; k < width; k++) out[k] = from[k] + share * (from[width + k] - from[k]);
    }
    double longest = 0.0;
    for (int i = oldest + 1; i < frames; i++) {
        const double step = times[i] - times[i - 1];
        if (step > longest) longest = step;
    }
    return longest;
}

/* Of each column of the rows from `first` on: the mean and the greatest. */
static PyObject *sum_up(const double *facts, int first, int end, int width) {
    PyObject *means = PyTuple_New(width), *tops = PyTuple_New(width);
    for (int k = 0; means && tops && k < width; k++) {
        double sum = 0.0, top = -INFINITY;
        for (int i = first; i < end; i++) {
            const double value = facts[(size_t)i * width + k];
            sum += value;
            if (value > top) top = value;
        }
        PyTuple_SET_ITEM(means, k, PyFloat_FromDouble(sum / (end - first)));
        PyTuple_SET_ITEM(tops, k, PyFloat_FromDouble(top));
    }
    return Py_BuildValue("NN", means, tops);
}

PyDoc_STRVAR(survey_doc,
    "survey(times, poses, facts, start, end, grid, snap, recent, out)\n--\n\n"
    "Put the poses from `start` up to `end` on a grid of times, which are given from the newest on, and\n"
    "sum up the facts of those frames that are at most `recent` older than the newest. times: [n]; poses:\n"
    "[n, ...]; facts: [n, facts]; grid: [points]; out: [points, ...], is filled; all are float64.\n"
    "Gives the longest step of time between the frames that the window spans, how many frames are older\n"
    "than `recent`, and of each fact the mean and the greatest.");

static PyObject *survey(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer times, poses, facts, grid, out;
    double snap, recent;
    int start, end;
    if (!PyArg_ParseTuple(args, "y*y*y*iiy*ddw*", &times, &poses, &facts, &start, &end, &grid, &snap, &recent, &out))
        return NULL;
    const Py_ssize_t number = sizeof(double), frames = times.len / number, points = grid.len / number;
    const Py_ssize_t width = frames ? poses.len / number / frames : 0, columns = frames ? facts.len / number / frames : 0;
    PyObject *found = NULL;
    if (width > 0 && points > 0 && poses.len == frames * width * number && facts.len == frames * columns * number &&
        out.len == points * width * number && 0 <= start && start < end && end <= frames) {
        const double *at = times.buf;
        const double longest = resample_frames(
            at + start, (double *)poses.buf + start * width, end - start, (int)width, grid.buf, (int)points, snap, out.buf);
        int first = start;
        while (first < end - 1 && at[first] < at[end - 1] - recent) first++;
        PyObject *sums = sum_up(facts.buf, first, end, (int)columns);
        if (sums) found = Py_BuildValue("diN", longest, first - start, sums);
    } else PyErr_SetString(PyExc_ValueError, "arrays of sizes that do not fit each other");
    PyBuffer_Release(&times), PyBuffer_Release(&poses), PyBuffer_Release(&facts);
    PyBuffer_Release(&grid), PyBuffer_Release(&out);
    return found;
}

PyDoc_STRVAR(fastest_doc,
    "find_fastest(poses, joints, root)\n--\n\n"
    "Give the largest squared step of any joint, and of the joint `root`, between two poses that follow\n"
    "each other; not a number if a coordinate is none. poses: float64 [n, joints, 3].");

static PyObject *find_fastest(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer poses;
    int joints, root;
    if (!PyArg_ParseTuple(args, "y*ii", &poses, &joints, &root)) return NULL;
    const double *at = poses.buf;
    double most[2] = {0.0, 0.0};
    if (joints < 1 || joints > 4096 || root < 0 || root >= joints ||
        poses.len % (3 * joints * (Py_ssize_t)sizeof(double))) {
        PyBuffer_Release(&poses);
        PyErr_SetString(PyExc_ValueError, "poses, joints and root do not fit each other");
        return NULL;
    }
    const Py_ssize_t frames = poses.len / (3 * joints * (Py_ssize_t)sizeof(double));
    for (Py_ssize_t i = joints; i < frames * joints; i++) {
        const double *now = at + 3 * i, *then = now - 3 * joints;
        const double x = now[0] - then[0], y = now[1] - then[1], z = now[2] - then[2];
        const double squared = x * x + y * y + z * z;
        for (int k = 0; k < 2; k++) /* what is not a number stays */
            if ((k == 0 || i % joints == root) && most[k] == most[k] && !(squared <= most[k])) most[k] = squared;
    }
    PyBuffer_Release(&poses);
    return Py_BuildValue("dd", most[0], most[1]);
}
