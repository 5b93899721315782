/* Where a window stands, and how near a latent is to what a gate knows; in full precision. */

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

/* What the streams see of a block of windows: poses, one window after the other. */
typedef float NAME(Seen)[BLOCK * MAX_OBSERVE][3 * MAX_JOINTS];

/* Positions, velocities and accelerations as the net sees them, into its streams from frame `first` on. */
static void NAME(place)(const Shape *s, const double *window, Encoded *out, NAME(Seen) * streams, int first) {
    const int frames = s->observe, coordinates = 3 * s->joints;
    const double *origin = window + ((frames - 1) * s->joints + s->hip) * 3;
    float (*const in[TOKENS])[3 * MAX_JOINTS] = {streams[0] + first, streams[1] + first, streams[2] + first};
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

/* Root mean square distance, per direction, of a latent to the nearest point of a gate. Into `apart`, unless
   it is NULL, go the squared distances of all of them, in whole tiles. */
static TARGET float NAME(distance)(
    const float *gate, const float *z, int size, int directions, int points, float *apart) {
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
                const VEC way = SUB(SET1(along[i]), LOAD(point + 16 * i + part));
                sum = FMA(way, way, sum);
            }
            if (apart) STORE(apart + tile + part, sum);
            least = MIN(least, sum);
        }
    }
    float found[LANES], nearest = INFINITY;
    STORE(found, least);
    for (int i = 0; i < LANES; i++) nearest = found[i] >= nearest ? nearest : found[i];
    return sqrtf(nearest / directions);
}

/* How much of each direction of a correction a window gets, from its squared distances to the points. */
static TARGET void NAME(recall)(const float *correction, const float *apart, int directions, float *amounts) {
    const int rank = padded((int)correction[0], 16), points = (int)correction[1];
    const VEC scale = SET1(-0.5f / (directions * correction[2] * correction[2]));
    const uint16_t *coefficients = (const uint16_t *)(correction + 16);
    VEC sum[MAX_RANK / LANES];
    for (int v = 0; v < rank / LANES; v++) sum[v] = ZERO();
    for (int tile = 0; tile < points; tile += 16) {
        float near[16];
        for (int part = 0; part < 16; part += LANES)
            STORE(near + part, NAME(exponential)(MUL(scale, LOAD(apart + tile + part))));
        for (int i = 0; i < 16 && tile + i < points; i++, coefficients += rank)
            for (int v = 0; v < rank / LANES; v++)
                sum[v] = FMA(SET1(near[i]), LOAD_HALF(coefficients + v * LANES), sum[v]);
    }
    for (int v = 0; v < rank / LANES; v++) STORE(amounts + v * LANES, sum[v]);
}

/* Give the corrected base its part in what a person's decoder says: `size` numbers, in tiles of 16. */
static TARGET void NAME(correct)(
    const float *correction, const float *amounts, const float *of_base, float *own, int size) {
    const int rank = padded((int)correction[0], 16), points = (int)correction[1];
    const uint16_t *basis = (const uint16_t *)(correction + 16) + (size_t)points * rank;
    const float share = correction[3];
    for (int first = 0; first < size; first += 16, basis += 16 * rank) {
        float add[16];
        for (int part = 0; part < 16; part += LANES) {
            VEC sum = ZERO();
            for (int r = 0; r < rank; r++) sum = FMA(SET1(amounts[r]), LOAD_HALF(basis + 16 * r + part), sum);
            STORE(add + part, sum);
        }
        for (int i = 0; i < 16 && first + i < size; i++)
            own[first + i] += share * (of_base[first + i] + add[i] - own[first + i]);
    }
}
