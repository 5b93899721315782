/* What this processor can do at best: for the floor that forecasts are compared with. */

/* Read memory as the products do, in single precision; the sum keeps the compiler honest. */
static TARGET float NAME(read)(const float *x, size_t count, int times) {
    VEC sum[8];
    for (int v = 0; v < 8; v++) sum[v] = ZERO();
    for (int i = 0; i < times; i++)
        for (size_t k = 0; k + 8 * LANES <= count; k += 8 * LANES)
            for (int v = 0; v < 8; v++) sum[v] = ADD(sum[v], LOAD(x + k + v * LANES));
    for (int v = 1; v < 8; v++) sum[0] = ADD(sum[0], sum[v]);
    return SUM(sum[0]);
}

/* The same in half precision, widened on the way. */
static TARGET float NAME(read_half)(const uint16_t *x, size_t count, int times) {
    VEC sum[8];
    for (int v = 0; v < 8; v++) sum[v] = ZERO();
    for (int i = 0; i < times; i++)
        for (size_t k = 0; k + 8 * LANES <= count; k += 8 * LANES)
            for (int v = 0; v < 8; v++) sum[v] = ADD(sum[v], LOAD_HALF(x + k + v * LANES));
    for (int v = 1; v < 8; v++) sum[0] = ADD(sum[0], sum[v]);
    return SUM(sum[0]);
}

/* The same in bfloat16. */
static TARGET float NAME(read_brief)(const uint16_t *x, size_t count, int times) {
    VEC sum[8], both[2];
    for (int v = 0; v < 8; v++) sum[v] = ZERO();
    for (int i = 0; i < times; i++) {
        for (size_t k = 0; k + 8 * LANES <= count; k += 8 * LANES) {
            for (int v = 0; v < 8; v += 2) {
                LOAD_PAIR(x + k + v * LANES, both[0], both[1]);
                for (int half = 0; half < 2; half++) sum[v + half] = ADD(sum[v + half], both[half]);
            }
        }
    }
    for (int v = 1; v < 8; v++) sum[0] = ADD(sum[0], sum[v]);
    return SUM(sum[0]);
}

/* Multiply and add, 16 vectors at a time, without memory. */
static TARGET float NAME(calculate)(int times) {
    VEC sum[16];
    const VEC factor = SET1(0.999f), addend = SET1(0.001f);
    for (int v = 0; v < 16; v++) sum[v] = SET1((float)v);
    for (int i = 0; i < times; i++)
        for (int v = 0; v < 16; v++) sum[v] = FMA(sum[v], factor, addend);
    for (int v = 1; v < 16; v++) sum[0] = ADD(sum[0], sum[v]);
    return SUM(sum[0]);
}

static const int NAME(lanes) = LANES;
