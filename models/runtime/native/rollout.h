/* The decoder, rolled out over the horizon; included for each kind of weights. */

typedef struct {
    const float *bias_start, *bias_z, *bias_c, *bias_h, *bias_project, *bias_mix, *gain, *shift;
    const float *bias_state, *bias_offset;
    const WEIGHT *start, *token_z, *token_c, *token_h, *project, *mix, *from_state;
    const FINE *ancestors, *offsets;
    KIND(Cell) cell;
} KIND(Decoder);

/* Find the parts of a decoder that `pack.py` laid out; gives its size in bytes. */
static size_t KIND(find_decoder)(KIND(Decoder) * d, const Shape *s, const char *block) {
    const float *f = (const float *)block;
    const int inputs = padded(3 * s->joints + TOKENS * s->token, 2);
    d->bias_start = f, f += s->state;
    d->bias_z = f, f += s->token;
    d->bias_c = f, f += s->token;
    d->bias_h = f, f += s->token;
    d->bias_project = f, f += 3 * s->token;
    d->bias_mix = f, f += s->token;
    d->gain = f, f += s->token;
    d->shift = f, f += s->token;
    d->cell.bias = f, f += 2 * s->state;
    d->cell.bias_input = f, f += s->state;
    d->cell.bias_hidden = f, f += s->state;
    d->bias_state = f, f += padded(s->joints * s->spl, TILE);
    d->bias_offset = f, f += padded(3 * s->joints, TILE);
    const WEIGHT *w = (const WEIGHT *)f;
    d->start = w, w += padded(s->z + s->c, 2) * s->state;
    d->token_z = w, w += padded(s->z, 2) * s->token;
    d->token_c = w, w += padded(s->c, 2) * s->token;
    d->token_h = w, w += s->state * s->token;
    d->project = w, w += s->token * 3 * s->token;
    d->mix = w, w += s->token * s->token;
    d->cell.input = w, w += inputs * 3 * s->state;
    d->cell.hidden = w, w += s->state * 3 * s->state;
    d->cell.inputs = inputs, d->cell.size = s->state;
    d->from_state = w, w += s->state * padded(s->joints * s->spl, TILE);
    const FINE *fine = (const FINE *)w;
    d->ancestors = fine;
    for (int place = 0; place < s->joints; place++) fine += 3 * s->depth[place] * s->spl;
    d->offsets = fine, fine += 3 * s->joints * s->spl;
    return (size_t)((const char *)fine - block);
}

/* One pose from the state, joint by joint along the kinematic tree. */
INLINE void KIND(pose)(const Shape *s, const KIND(Decoder) * d, const float *first, float *out) {
    float known[MAX_JOINTS][3 * MAX_JOINTS]; /* offsets of a joint's ancestors, and its own */
    const FINE *ancestors = d->ancestors, *offsets = d->offsets;
    for (int place = 0; place < s->joints; place++) {
        float hidden[MAX_SPL] __attribute__((aligned(64)));
        const int seen = 3 * s->depth[place], spl = s->spl;
        if (seen) memcpy(known[place], known[s->parent[place]], seen * sizeof(float));
        for (int i = 0; i < spl; i += LANES) {
            VEC sum = LOAD(first + place * spl + i);
            for (int k = 0; k < seen; k++)
                sum = FMA(SET1(known[place][k]), LOAD_FINE(ancestors + k * spl + i), sum);
            STORE(hidden + i, MAX(ZERO(), sum));
        }
        for (int axis = 0; axis < 3; axis++) {
            VEC sum = ZERO();
            for (int i = 0; i < spl; i += LANES)
                sum = FMA(LOAD(hidden + i), LOAD_FINE(offsets + axis * spl + i), sum);
            const float offset = SUM(sum) + d->bias_offset[3 * place + axis];
            known[place][seen + axis] = offset;
            out[3 * s->order[place] + axis] = offset;
        }
        ancestors += seen * spl;
        offsets += 3 * spl;
    }
}

/* Roll out `rows` windows; `out` is displacements in the net's units, [rows][horizon][joints][3]. */
INLINE void KIND(roll)(
    const int rows, const Shape *s, const KIND(Decoder) * d, const Encoded *const *encoded, float *const *out) {
    float z[ROWS][MAX_Z + MAX_C], c[ROWS][MAX_C + 2], state[ROWS][MAX_HIDDEN];
    float tokens[ROWS][TOKENS * MAX_TOKEN], split[ROWS][TOKENS * 3 * MAX_TOKEN];
    float x[ROWS][MAX_INPUTS], attended[TOKENS * MAX_TOKEN], mixed[TOKENS * MAX_TOKEN];
    float first[ROWS][MAX_JOINTS * MAX_SPL], fresh[ROWS][MAX_TOKEN], project[ROWS][3 * MAX_TOKEN];
    const int token = s->token, coordinates = 3 * s->joints, place = TOKENS * token;
    for (int r = 0; r < rows; r++) {
        memcpy(z[r], encoded[r]->z, sizeof z[r]);
        memset(c[r], 0, sizeof c[r]);
        memcpy(c[r], encoded[r]->z + s->z, s->c * sizeof(float));
        memset(x[r], 0, sizeof x[r]);
        memcpy(x[r] + place, encoded[r]->seed, coordinates * sizeof(float));
    }
    KIND(multiply)(rows, state[0], MAX_HIDDEN, z[0], MAX_Z + MAX_C, d->start, d->bias_start,
                   padded(s->z + s->c, 2), s->state);
    KIND(multiply)(rows, tokens[0], TOKENS * MAX_TOKEN, z[0], MAX_Z + MAX_C, d->token_z, d->bias_z,
                   padded(s->z, 2), token);
    KIND(multiply)(rows, tokens[0] + token, TOKENS * MAX_TOKEN, c[0], MAX_C + 2, d->token_c, d->bias_c,
                   padded(s->c, 2), token);
    for (int t = 0; t < 2; t++)
        KIND(multiply)(rows, split[0] + t * 3 * token, TOKENS * 3 * MAX_TOKEN, tokens[0] + t * token,
                       TOKENS * MAX_TOKEN, d->project, d->bias_project, token, 3 * token);
    for (int r = 0; r < rows; r++) NAME(make_hyperbolic)(state[r], s->state);
    for (int frame = 0; frame < s->horizon; frame++) {
        KIND(multiply)(rows, fresh[0], MAX_TOKEN, state[0], MAX_HIDDEN, d->token_h, d->bias_h, s->state, token);
        KIND(multiply)(rows, project[0], 3 * MAX_TOKEN, fresh[0], MAX_TOKEN, d->project, d->bias_project, token,
                       3 * token);
        for (int r = 0; r < rows; r++) {
            memcpy(tokens[r] + 2 * token, fresh[r], token * sizeof(float));
            memcpy(split[r] + 6 * token, project[r], 3 * token * sizeof(float));
            NAME(attend)(attended, split[r], token, s->decoder_heads);
            KIND(multiply)(TOKENS, mixed, token, attended, token, d->mix, d->bias_mix, token, token);
            for (int t = 0; t < TOKENS; t++) {
                memcpy(x[r] + t * token, tokens[r] + t * token, token * sizeof(float));
                NAME(normalize)(x[r] + t * token, mixed + t * token, d->gain, d->shift, token);
            }
        }
        KIND(step)(rows, &d->cell, state[0], x[0], MAX_INPUTS);
        KIND(multiply)(rows, first[0], MAX_JOINTS * MAX_SPL, state[0], MAX_HIDDEN, d->from_state, d->bias_state,
                       s->state, padded(s->joints * s->spl, TILE));
        for (int r = 0; r < rows; r++) {
            float *made = out[r] + frame * coordinates;
            KIND(pose)(s, d, first[r], made);
            for (int i = 0; i < coordinates; i++) x[r][place + i] = encoded[r]->seed[i] + made[i];
        }
    }
}

static TARGET void KIND(decode)(
    const Shape *s, const char *block, const Encoded *const *encoded, float *const *out, int count) {
    KIND(Decoder) d;
    KIND(find_decoder)(&d, s, block);
    int done = 0;
    for (; count - done >= ROWS; done += ROWS) KIND(roll)(ROWS, s, &d, encoded + done, out + done);
    encoded += done, out += done;
    if (count - done == 3) KIND(roll)(3, s, &d, encoded, out);
    if (count - done == 2) KIND(roll)(2, s, &d, encoded, out);
    if (count - done == 1) KIND(roll)(1, s, &d, encoded, out);
}
