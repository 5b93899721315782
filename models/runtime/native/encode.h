/* From placed windows to the latent: three recurrent streams, attention; for each kind of weights. */

typedef struct {
    KIND(Cell) streams[TOKENS];
    const float *bias_project, *bias_mix, *gain, *shift, *bias_latent;
    const WEIGHT *project, *mix, *to_z, *to_c;
} KIND(Encoder);

/* Find the parts of an encoder that `pack.py` laid out; gives its size in bytes. */
static size_t KIND(find_encoder)(KIND(Encoder) * e, const Shape *s, const char *block) {
    const float *f = (const float *)block;
    const int inputs = padded(3 * s->joints, 2), hidden = s->hidden;
    for (int i = 0; i < TOKENS; i++) {
        e->streams[i].bias = f, f += 2 * hidden;
        e->streams[i].bias_input = f, f += hidden;
        e->streams[i].bias_hidden = f, f += hidden;
    }
    e->bias_project = f, f += 3 * hidden;
    e->bias_mix = f, f += hidden;
    e->gain = f, f += hidden;
    e->shift = f, f += hidden;
    e->bias_latent = f, f += padded(s->z, TILE) + padded(s->c, TILE);
    const WEIGHT *w = (const WEIGHT *)f;
    for (int i = 0; i < TOKENS; i++) {
        e->streams[i].inputs = inputs, e->streams[i].size = hidden;
        e->streams[i].input = w, w += inputs * 3 * hidden;
        e->streams[i].hidden = w, w += hidden * 3 * hidden;
    }
    e->project = w, w += hidden * 3 * hidden;
    e->mix = w, w += hidden * hidden;
    e->to_z = w, w += 3 * hidden * padded(s->z, TILE);
    e->to_c = w, w += 3 * hidden * padded(s->c, TILE);
    return (size_t)((const char *)w - block);
}

/* out (+)= x W for any number of vectors: a tile comes from the second level of the cache once, and stays
   in the first until all of them have met it. */
static TARGET void KIND(multiply_many)(
    int rows, float *out, int out_step, const float *x, int x_step, const WEIGHT *w, const float *bias, int inputs,
    int outputs) {
    for (int tile = 0; tile < outputs; tile += TILE, w += TILE * inputs) {
        for (int done = 0, some; done < rows; done += some) {
            some = rows - done < ROWS ? rows - done : LANES == 16 && rows - done >= 2 * ROWS ? 2 * ROWS : ROWS;
            KIND(multiply)(some, out + done * out_step + tile, out_step, x + done * x_step, x_step, w,
                           bias ? bias + tile : NULL, inputs, TILE);
        }
    }
}

/* Run a stream over all frames. What the gates are given by the frames does not depend on the state, so it
   comes first, in one product; what the state adds to it follows frame by frame. */
static TARGET void KIND(run_stream)(
    int rows, int frames, const KIND(Cell) * cell, float (*seen)[3 * MAX_JOINTS], float (*state)[MAX_HIDDEN]) {
    float gates[BLOCK * MAX_OBSERVE][3 * MAX_HIDDEN] __attribute__((aligned(64)));
    float kept[BLOCK][MAX_HIDDEN] __attribute__((aligned(64)));
    const int size = cell->size, step = frames * 3 * MAX_HIDDEN;
    KIND(multiply_many)(rows * frames, gates[0], 3 * MAX_HIDDEN, seen[0], 3 * MAX_JOINTS, cell->input, cell->bias,
                        cell->inputs, 3 * size);
    memset(state, 0, rows * sizeof *state);
    for (int t = 0; t < frames; t++) {
        const int known = t ? size : 0; /* the state begins as zeros, and adds nothing */
        KIND(multiply_many)(rows, gates[t], step, state[0], MAX_HIDDEN, cell->hidden, NULL, known, 2 * size);
        KIND(multiply_many)(rows, kept[0], MAX_HIDDEN, state[0], MAX_HIDDEN, cell->hidden + 2 * size * size,
                            cell->bias_hidden, known, size);
        NAME(renew)(rows, size, state[0], gates[t], step, gates[t] + 2 * size, step, kept[0]);
    }
}

/* Attention over the streams of each window, in place. */
static TARGET void KIND(attend_rows)(int rows, const Shape *s, const KIND(Encoder) * e, float *tokens) {
    float split[BLOCK * TOKENS * 3 * MAX_HIDDEN], attended[BLOCK * TOKENS * MAX_HIDDEN];
    float mixed[BLOCK * TOKENS * MAX_HIDDEN];
    const int width = s->hidden, window = TOKENS * width;
    KIND(multiply_many)(rows * TOKENS, split, 3 * width, tokens, width, e->project, e->bias_project, width, 3 * width);
    for (int r = 0; r < rows; r++) NAME(attend)(attended + r * window, split + 3 * r * window, width, s->heads);
    KIND(multiply_many)(rows * TOKENS, mixed, width, attended, width, e->mix, e->bias_mix, width, width);
    for (int i = 0; i < rows * window; i += width) NAME(normalize)(tokens + i, mixed + i, e->gain, e->shift, width);
}

/* Encode `rows` windows that lie one after the other. */
static TARGET void KIND(encode_rows)(
    int rows, const Shape *s, const KIND(Encoder) * e, const double *windows, Encoded *out) {
    NAME(Seen) seen[TOKENS];
    float tokens[BLOCK * TOKENS * MAX_HIDDEN], state[BLOCK][MAX_HIDDEN];
    float z[BLOCK][MAX_Z + TILE], c[BLOCK][MAX_C + TILE];
    const int frames = s->observe, width = s->hidden, window = TOKENS * width;
    for (int i = 0; i < TOKENS; i++) memset(seen[i], 0, rows * frames * sizeof seen[i][0]);
    for (int r = 0; r < rows; r++)
        NAME(place)(s, windows + (size_t)r * frames * s->joints * 3, out + r, seen, r * frames);
    for (int stream = 0; stream < TOKENS; stream++) {
        KIND(run_stream)(rows, frames, &e->streams[stream], seen[stream], state);
        for (int r = 0; r < rows; r++) memcpy(tokens + r * window + stream * width, state[r], width * sizeof(float));
    }
    KIND(attend_rows)(rows, s, e, tokens);
    KIND(multiply_many)(rows, z[0], MAX_Z + TILE, tokens, window, e->to_z, e->bias_latent, window, padded(s->z, TILE));
    KIND(multiply_many)(rows, c[0], MAX_C + TILE, tokens, window, e->to_c, e->bias_latent + padded(s->z, TILE), window,
                        padded(s->c, TILE));
    for (int r = 0; r < rows; r++) {
        NAME(softmax)(c[r], s->c);
        memset(out[r].z, 0, sizeof out[r].z);
        memcpy(out[r].z, z[r], s->z * sizeof(float));
        memcpy(out[r].z + s->z, c[r], s->c * sizeof(float));
    }
}

static TARGET void KIND(encode)(const Shape *s, const char *block, const double *windows, Encoded *out, int count) {
    KIND(Encoder) e;
    const size_t size = (size_t)s->observe * s->joints * 3;
    KIND(find_encoder)(&e, s, block);
    for (int done = 0, rows; done < count; done += rows) {
        rows = count - done < BLOCK ? count - done : BLOCK;
        KIND(encode_rows)(rows, s, &e, windows + done * size, out + done);
    }
}
