/* The hidden matrix of a stream whose weights are symmetric, left and right (models/symmetry.py), in half
   of the arithmetic: its blocks are [[A, B], [B, A]], so the sum of the state's halves meets A + B and
   their difference A - B, each of half the inputs and outputs. Always in single precision. */

typedef struct {
    const float *sum, *difference; /* (A + B) / 2 and (A - B) / 2 of all gates */
} NAME(Folded);

enum { NAME(HALF) = MAX_HIDDEN / 2, NAME(ROOM) = 3 * MAX_HIDDEN / 2 + TILE };

/* Numbers of each of the two. */
static inline int NAME(measure_folded)(int size) { return size / 2 * padded(3 * size / 2, TILE); }

/* Add what both sides give to one of the gates of one window, or to its bias. */
INLINE void NAME(unfold)(float *out, const float *to, const float *sum, const float *difference, int half) {
    for (int i = 0; i < half; i += LANES) {
        const VEC same = LOAD(sum + i), apart = LOAD(difference + i);
        STORE(out + i, ADD(LOAD(to + i), ADD(same, apart)));
        STORE(out + half + i, ADD(LOAD(to + half + i), SUB(same, apart)));
    }
}

/* What the state adds to the gates of `rows` windows, `step` apart, and the third gate's part of it. */
static TARGET void NAME(multiply_folded)(
    int rows, int size, const NAME(Folded) * w, const float *state, float *gates, int step, float *kept,
    const float *bias) {
    static const float zeros[NAME(ROOM)];
    float both[2][BLOCK][NAME(HALF)] __attribute__((aligned(64)));
    float made[2][BLOCK][NAME(ROOM)] __attribute__((aligned(64)));
    const int half = size / 2;
    for (int r = 0; r < rows; r++) {
        for (int i = 0; i < half; i += LANES) {
            const VEC left = LOAD(state + r * MAX_HIDDEN + i), right = LOAD(state + r * MAX_HIDDEN + half + i);
            STORE(both[0][r] + i, ADD(left, right));
            STORE(both[1][r] + i, SUB(left, right));
        }
    }
    KIND(multiply_many)(rows, made[0][0], NAME(ROOM), both[0][0], NAME(HALF), w->sum, zeros, half, 3 * half);
    KIND(multiply_many)(rows, made[1][0], NAME(ROOM), both[1][0], NAME(HALF), w->difference, zeros, half, 3 * half);
    for (int r = 0; r < rows; r++, gates += step, kept += MAX_HIDDEN) {
        for (int gate = 0; gate < 2; gate++)
            NAME(unfold)(gates + gate * size, gates + gate * size, made[0][r] + gate * half, made[1][r] + gate * half, half);
        NAME(unfold)(kept, bias, made[0][r] + size, made[1][r] + size, half);
    }
}
