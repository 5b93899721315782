/* Products of vectors with a matrix, and the recurrent cell; included for each kind of weights.

   A matrix is stored in tiles of 64 outputs: for each input its 64 weights, so that a product reads
   memory in one direction. Inputs are padded to an even number by zeros. How the 64 stand within
   their row is a matter of the kind of weights: see PLACE_OF. */

INLINE void KIND(multiply_rows)(
    const int rows, float *restrict out, int out_step, const float *restrict x, int x_step,
    const WEIGHT *restrict w, const float *restrict bias, int inputs, int outputs) {
    const int vectors = rows == 1 || (LANES == 16 && rows <= ROWS) ? 4 : 2; /* as many sums as there are registers */
    for (int tile = 0; tile < outputs; tile += TILE, w += TILE * inputs) {
        for (int first = 0; first < TILE / LANES; first += vectors) {
            const WEIGHT *part = w + first * LANES;
            VEC sum[2 * ROWS][4], weights[4];
            for (int r = 0; r < rows; r++) {
                for (int v = 0; v < vectors; v++) {
                    const int at = tile + PLACE_OF(first + v);
                    sum[r][v] = bias ? LOAD(bias + at) : LOAD(out + r * out_step + at);
                    if (rows == 1) sum[1][v] = ZERO();
                }
            }
            if (rows == 1) { /* two chains of sums, or each would wait for the one before */
                for (int k = 0; k < inputs; k += 2) {
                    for (int chain = 0; chain < 2; chain++, part += TILE) {
                        for (int v = 0; v < 4; v += 2)
                            LOAD_WEIGHTS(part + v * LANES, weights[v], weights[v + 1]);
                        for (int v = 0; v < 4; v++)
                            sum[chain][v] = FMA(SET1(x[k + chain]), weights[v], sum[chain][v]);
                    }
                }
                for (int v = 0; v < 4; v++) sum[0][v] = ADD(sum[0][v], sum[1][v]);
            } else {
                for (int k = 0; k < inputs; k++, part += TILE) {
                    for (int v = 0; v < vectors; v += 2)
                        LOAD_WEIGHTS(part + v * LANES, weights[v], weights[v + 1]);
                    for (int r = 0; r < rows; r++) {
                        const VEC given = SET1(x[r * x_step + k]);
                        for (int v = 0; v < vectors; v++)
                            sum[r][v] = FMA(given, weights[v], sum[r][v]);
                    }
                }
            }
            for (int r = 0; r < rows; r++)
                for (int v = 0; v < vectors; v++)
                    STORE(out + r * out_step + tile + PLACE_OF(first + v), sum[r][v]);
        }
    }
}

/* A function of its own for each number of rows, so that the loops over them are laid out flat. */
#define MULTIPLY(rows) \
    static TARGET __attribute__((noinline)) void KIND(multiply_##rows)( \
        float *out, int out_step, const float *x, int x_step, const WEIGHT *w, const float *bias, int inputs, \
        int outputs) { \
        KIND(multiply_rows)(rows, out, out_step, x, x_step, w, bias, inputs, outputs); \
    }
MULTIPLY(1)
MULTIPLY(2)
MULTIPLY(3)
MULTIPLY(4)
MULTIPLY(8)
#undef MULTIPLY

/* out (+)= x W for 1 to 4 or 8 vectors at once; `bias` is added, NULL: to what is in `out`. */
INLINE void KIND(multiply)(
    int rows, float *out, int out_step, const float *x, int x_step, const WEIGHT *w, const float *bias, int inputs,
    int outputs) {
    if (rows == 1) KIND(multiply_1)(out, out_step, x, x_step, w, bias, inputs, outputs);
    if (rows == 2) KIND(multiply_2)(out, out_step, x, x_step, w, bias, inputs, outputs);
    if (rows == 3) KIND(multiply_3)(out, out_step, x, x_step, w, bias, inputs, outputs);
    if (rows == 4) KIND(multiply_4)(out, out_step, x, x_step, w, bias, inputs, outputs);
    if (rows == 8) KIND(multiply_8)(out, out_step, x, x_step, w, bias, inputs, outputs);
}

/* Weights of a recurrent cell (GRU): gates reset, update, new, as torch orders them. */
typedef struct {
    const WEIGHT *input, *hidden;
    const float *bias, *bias_input, *bias_hidden;
    int inputs, size;
} KIND(Cell);

/* One step of the cell for `rows` vectors; `state` is replaced. */
INLINE void KIND(step)(const int rows, const KIND(Cell) * cell, float *state, const float *x, int x_step) {
    float gates[ROWS][2 * MAX_HIDDEN] __attribute__((aligned(64)));
    float given[ROWS][MAX_HIDDEN] __attribute__((aligned(64)));
    float kept[ROWS][MAX_HIDDEN] __attribute__((aligned(64)));
    const int size = cell->size;
    KIND(multiply)(rows, gates[0], 2 * MAX_HIDDEN, x, x_step, cell->input, cell->bias, cell->inputs, 2 * size);
    KIND(multiply)(rows, gates[0], 2 * MAX_HIDDEN, state, MAX_HIDDEN, cell->hidden, NULL, size, 2 * size);
    KIND(multiply)(rows, given[0], MAX_HIDDEN, x, x_step, cell->input + 2 * size * cell->inputs,
                   cell->bias_input, cell->inputs, size);
    KIND(multiply)(rows, kept[0], MAX_HIDDEN, state, MAX_HIDDEN, cell->hidden + 2 * size * size,
                   cell->bias_hidden, size, size);
    NAME(renew)(rows, size, state, gates[0], 2 * MAX_HIDDEN, given[0], MAX_HIDDEN, kept[0]);
}
