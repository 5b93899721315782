/* From windows to the latent: placement, three recurrent streams, attention; full precision. */

typedef struct {
    KIND(Cell) streams[TOKENS];
    const float *bias_project, *bias_mix, *gain, *shift, *bias_latent;
    const float *project, *mix, *to_z, *to_c;
} NAME(Encoder);

static size_t NAME(find_encoder)(NAME(Encoder) * e, const Shape *s, const char *block) {
    const float *f = (const float *)block;
    const int inputs = padded(3 * s->joints, 2), hidden = s->hidden;
    for (int i = 0; i < TOKENS; i++) {
        KIND(Cell) *cell = &e->streams[i];
        cell->inputs = inputs, cell->size = hidden;
        cell->bias = f, f += 2 * hidden;
        cell->bias_input = f, f += hidden;
        cell->bias_hidden = f, f += hidden;
        cell->input = f, f += inputs * 3 * hidden;
        cell->hidden = f, f += hidden * 3 * hidden;
    }
    e->bias_project = f, f += 3 * hidden;
    e->bias_mix = f, f += hidden;
    e->gain = f, f += hidden;
    e->shift = f, f += hidden;
    e->bias_latent = f, f += padded(s->z, TILE) + padded(s->c, TILE);
    e->project = f, f += hidden * 3 * hidden;
    e->mix = f, f += hidden * hidden;
    e->to_z = f, f += 3 * hidden * padded(s->z, TILE);
    e->to_c = f, f += 3 * hidden * padded(s->c, TILE);
    return (size_t)((const char *)f - block);
}

/* The turn about the vertical that puts the person's left side towards -x. */
static void NAME(face)(const Shape *s, const double *window, Encoded *out) {
    const int ends[4] = {s->left_hip, s->right_hip, s->left_shoulder, s->right_shoulder};
    float across[2] = {0.0f, 0.0f};
    for (int end = 0; end < 4; end++) {
        for (int axis = 0; axis < 2; axis++) {
            float sum = 0.0f;
            for (int i = s->observe - s->heading_frames; i < s->observe; i++)
                sum += (float)window[(i * s->joints + ends[end]) * 3 + 2 * axis];
            across[axis] += (end % 2 ? -1.0f : 1.0f) * (sum / s->heading_frames);
        }
    }
    const float length = sqrtf(across[0] * across[0] + across[1] * across[1]);
    const int seen = s->turns && length > s->min_across;
    out->cosine = seen ? -across[0] / length : 1.0f;
    out->sine = seen ? -across[1] / length : 0.0f;
}

/* Positions, velocities and accelerations as the net sees them, [3][observe][joints][3]. */
static void NAME(place)(const Shape *s, const double *window, Encoded *out, float (*in)[MAX_OBSERVE][3 * MAX_JOINTS]) {
    const int frames = s->observe, coordinates = 3 * s->joints;
    const double *origin = window + ((frames - 1) * s->joints + s->hip) * 3;
    NAME(face)(s, window, out);
    for (int t = 0; t < frames; t++) {
        for (int joint = 0; joint < s->joints; joint++) {
            const double *at = window + (t * s->joints + joint) * 3;
            const float x = (float)(at[0] - origin[0]), y = (float)(at[1] - origin[1]);
            const float z = (float)(at[2] - origin[2]);
            const float turned[3] = {out->cosine * x + out->sine * z, y, out->cosine * z - out->sine * x};
            for (int axis = 0; axis < 3; axis++)
                in[0][t][3 * joint + axis] = (turned[axis] - s->mean_pose[3 * joint + axis]) / s->scales[0];
        }
        for (int i = 0; i < coordinates; i++)
            in[1][t][i] = t ? in[0][t][i] - in[0][t - 1][i] : 0.0f;
        for (int i = 0; i < coordinates; i++)
            in[2][t][i] = t > 1 ? (in[1][t][i] - in[1][t - 1][i]) / s->scales[2] : 0.0f;
    }
    for (int t = 0; t < frames; t++)
        for (int i = 0; i < coordinates; i++) in[1][t][i] /= s->scales[1];
    memcpy(out->seed, in[0][frames - 1], coordinates * sizeof(float));
}

/* Encode `rows` windows that lie one after the other. */
INLINE void NAME(encode_rows)(
    const int rows, const Shape *s, const NAME(Encoder) * e, const double *windows, Encoded *out) {
    float in[ROWS][TOKENS][MAX_OBSERVE][3 * MAX_JOINTS];
    float hidden[ROWS][TOKENS * MAX_HIDDEN], state[ROWS][MAX_HIDDEN];
    float split[TOKENS * 3 * MAX_HIDDEN], attended[TOKENS * MAX_HIDDEN], mixed[TOKENS * MAX_HIDDEN];
    const int step = TOKENS * MAX_OBSERVE * 3 * MAX_JOINTS, width = s->hidden;
    for (int r = 0; r < rows; r++) {
        memset(in[r], 0, sizeof in[r]);
        NAME(place)(s, windows + (size_t)r * s->observe * s->joints * 3, out + r, in[r]);
    }
    for (int stream = 0; stream < TOKENS; stream++) {
        memset(state, 0, sizeof state);
        for (int t = 0; t < s->observe; t++)
            KIND(step)(rows, &e->streams[stream], state[0], in[0][stream][t], step);
        for (int r = 0; r < rows; r++) memcpy(hidden[r] + stream * width, state[r], width * sizeof(float));
    }
    for (int r = 0; r < rows; r++) {
        KIND(multiply)(TOKENS, split, 3 * width, hidden[r], width, e->project, e->bias_project, width, 3 * width);
        NAME(attend)(attended, split, width, s->heads);
        KIND(multiply)(TOKENS, mixed, width, attended, width, e->mix, e->bias_mix, width, width);
        for (int t = 0; t < TOKENS; t++)
            NAME(normalize)(hidden[r] + t * width, mixed + t * width, e->gain, e->shift, width);
    }
    float z[ROWS][MAX_Z + TILE], c[ROWS][MAX_C + TILE];
    KIND(multiply)(rows, z[0], MAX_Z + TILE, hidden[0], TOKENS * MAX_HIDDEN, e->to_z, e->bias_latent, 3 * width,
                   padded(s->z, TILE));
    KIND(multiply)(rows, c[0], MAX_C + TILE, hidden[0], TOKENS * MAX_HIDDEN, e->to_c,
                   e->bias_latent + padded(s->z, TILE), 3 * width, padded(s->c, TILE));
    for (int r = 0; r < rows; r++) {
        NAME(softmax)(c[r], s->c);
        memset(out[r].z, 0, sizeof out[r].z);
        memcpy(out[r].z, z[r], s->z * sizeof(float));
        memcpy(out[r].z + s->z, c[r], s->c * sizeof(float));
    }
}

static TARGET void NAME(encode)(const Shape *s, const char *block, const double *windows, Encoded *out, int count) {
    NAME(Encoder) e;
    const size_t size = (size_t)s->observe * s->joints * 3;
    NAME(find_encoder)(&e, s, block);
    int done = 0;
    for (; count - done >= ROWS; done += ROWS)
        NAME(encode_rows)(ROWS, s, &e, windows + done * size, out + done);
    windows += done * size, out += done;
    if (count - done == 3) NAME(encode_rows)(3, s, &e, windows, out);
    if (count - done == 2) NAME(encode_rows)(2, s, &e, windows, out);
    if (count - done == 1) NAME(encode_rows)(1, s, &e, windows, out);
}

/* Root mean square distance, per direction, of a latent to the nearest point of a gate. */
static TARGET float NAME(distance)(const float *gate, const float *z, int size, int directions, int points) {
    float along[2 * TILE] = {0};
    const float *mean = gate, *axes = gate + padded(size, 16), *point = axes + size * padded(directions, 16);
    for (int k = 0; k < size; k++) {
        const VEC apart = SET1(z[k] - mean[k]);
        for (int i = 0; i < directions; i += LANES)
            STORE(along + i, FMA(apart, LOAD(axes + k * padded(directions, 16) + i), LOAD(along + i)));
    }
    VEC least = SET1(INFINITY);
    for (int tile = 0; tile < points; tile += 16, point += 16 * directions) {
        for (int part = 0; part < 16; part += LANES) {
            VEC sum = ZERO();
            for (int i = 0; i < directions; i++) {
                const VEC apart = SUB(SET1(along[i]), LOAD(point + 16 * i + part));
                sum = FMA(apart, apart, sum);
            }
            least = MIN(least, sum);
        }
    }
    float found[LANES], nearest = INFINITY;
    STORE(found, least);
    for (int i = 0; i < LANES; i++) nearest = found[i] >= nearest ? nearest : found[i];
    return sqrtf(nearest / directions);
}
