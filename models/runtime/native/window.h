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

PyDoc_STRVAR(resample_doc,
    "resample(times, poses, grid, snap, out)\n--\n\n"
    "Put poses on a grid of times, which are given from the newest on; all are float64. `out` is filled.\n"
    "Gives the longest step of time between the frames that the window spans.");

static PyObject *resample(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer times, poses, grid, out;
    double snap, longest = 0.0;
    if (!PyArg_ParseTuple(args, "y*y*y*dw*", &times, &poses, &grid, &snap, &out)) return NULL;
    const Py_ssize_t frames = times.len / sizeof(double), points = grid.len / sizeof(double);
    const Py_ssize_t width = frames ? poses.len / (Py_ssize_t)sizeof(double) / frames : 0;
    const int fits = width > 0 && points > 0 && poses.len == frames * width * (Py_ssize_t)sizeof(double) &&
                     out.len == points * width * (Py_ssize_t)sizeof(double);
    if (fits) longest = resample_frames(times.buf, poses.buf, (int)frames, (int)width, grid.buf, (int)points, snap, out.buf);
    else PyErr_SetString(PyExc_ValueError, "arrays of sizes that do not fit each other");
    PyBuffer_Release(&times), PyBuffer_Release(&poses), PyBuffer_Release(&grid), PyBuffer_Release(&out);
    return fits ? PyFloat_FromDouble(longest) : NULL;
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
    const Py_ssize_t frames = joints > 0 ? poses.len / (3 * joints * (Py_ssize_t)sizeof(double)) : 0;
    double most[2] = {0.0, 0.0};
    for (Py_ssize_t i = joints; root >= 0 && i < frames * joints; i++) {
        const double *now = at + 3 * i, *then = now - 3 * joints;
        const double x = now[0] - then[0], y = now[1] - then[1], z = now[2] - then[2];
        const double squared = x * x + y * y + z * z;
        for (int k = 0; k < 2; k++) /* what is not a number stays */
            if ((k == 0 || i % joints == root) && most[k] == most[k] && !(squared <= most[k])) most[k] = squared;
    }
    PyBuffer_Release(&poses);
    return Py_BuildValue("dd", most[0], most[1]);
}
