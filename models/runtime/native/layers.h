/* Layers for one kind of processor; included once for each. */
#define JOIN_(a, b) a##_##b
#define JOIN(a, b) JOIN_(a, b)
#define NAME(a) JOIN(a, SUFFIX)
#define INLINE static inline __attribute__((always_inline)) TARGET

#if LANES == 8
static inline __attribute__((always_inline)) TARGET float sum_of_8(__m256 v) {
    __m128 four = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    __m128 two = _mm_add_ps(four, _mm_movehl_ps(four, four));
    return _mm_cvtss_f32(_mm_add_ss(two, _mm_shuffle_ps(two, two, 1)));
}
#endif

/* e^x to one unit in the last place or two (Cephes); not a number stays so. */
INLINE VEC NAME(exponential)(VEC x) {
    x = MIN(SET1(88.0f), MAX(SET1(-87.0f), x));
    VEC n = ROUND(MUL(x, SET1(1.44269504088896341f)));
    x = FMA(n, SET1(-0.693359375f), x);
    x = FMA(n, SET1(2.12194440e-4f), x);
    VEC y = SET1(1.9875691500e-4f);
    y = FMA(y, x, SET1(1.3981999507e-3f));
    y = FMA(y, x, SET1(8.3334519073e-3f));
    y = FMA(y, x, SET1(4.1665795894e-2f));
    y = FMA(y, x, SET1(1.6666665459e-1f));
    y = FMA(y, x, SET1(5.0000001201e-1f));
    y = ADD(FMA(MUL(x, x), y, x), SET1(1.0f));
    return MUL(y, POWER_OF_2(n));
}

INLINE VEC NAME(sigmoid)(VEC x) {
    VEC one = SET1(1.0f);
    return DIV(one, ADD(one, NAME(exponential)(SUB(ZERO(), x))));
}

INLINE VEC NAME(hyperbolic)(VEC x) {
    VEC one = SET1(1.0f);
    return SUB(one, DIV(SET1(2.0f), ADD(one, NAME(exponential)(ADD(x, x)))));
}

INLINE void NAME(make_hyperbolic)(float *x, int count) {
    for (int i = 0; i < count; i += LANES) STORE(x + i, NAME(hyperbolic)(LOAD(x + i)));
}

/* Softmax over the first `count` of numbers that have room for whole vectors. */
INLINE void NAME(softmax)(float *x, int count) {
    float most = x[0], sum = 0.0f;
    for (int i = 1; i < count; i++) most = x[i] > most ? x[i] : most;
    for (int i = 0; i < count; i += LANES)
        STORE(x + i, NAME(exponential)(SUB(LOAD(x + i), SET1(most))));
    for (int i = 0; i < count; i++) sum += x[i];
    for (int i = 0; i < count; i++) x[i] /= sum;
}

/* Layer norm of x + y, into x. */
INLINE void NAME(normalize)(float *x, const float *y, const float *gain, const float *bias, int width) {
    VEC sum = ZERO(), square = ZERO();
    for (int i = 0; i < width; i += LANES) {
        VEC both = ADD(LOAD(x + i), LOAD(y + i));
        STORE(x + i, both);
        sum = ADD(sum, both);
    }
    VEC mean = SET1(SUM(sum) / width);
    for (int i = 0; i < width; i += LANES) {
        VEC apart = SUB(LOAD(x + i), mean);
        square = FMA(apart, apart, square);
    }
    VEC scale = SET1(1.0f / sqrtf(SUM(square) / width + 1e-5f));
    for (int i = 0; i < width; i += LANES) {
        VEC apart = MUL(SUB(LOAD(x + i), mean), scale);
        STORE(x + i, FMA(apart, LOAD(gain + i), LOAD(bias + i)));
    }
}

/* The state of a recurrent cell after a step, from what the products gave: its gates (reset, update), and
   the third in two parts, of the input and of the state; `gates` and `given` are `step` and `given_step` apart. */
INLINE void NAME(renew)(
    int rows, int size, float *state, const float *gates, int step, const float *given, int given_step,
    const float *kept) {
    for (int r = 0; r < rows; r++, gates += step, given += given_step, kept += MAX_HIDDEN, state += MAX_HIDDEN) {
        for (int i = 0; i < size; i += LANES) {
            const VEC reset = NAME(sigmoid)(LOAD(gates + i));
            const VEC update = NAME(sigmoid)(LOAD(gates + size + i));
            const VEC fresh = NAME(hyperbolic)(FMA(reset, LOAD(kept + i), LOAD(given + i)));
            STORE(state + i, FMA(update, SUB(LOAD(state + i), fresh), fresh));
        }
    }
}

/* Dot products of three tokens with each other, softmax, weighted sums; `split` holds each token's
   query, key and value one after the other. A softmax is over three numbers, so all of them are done
   side by side: weights[j] holds what every head and token gives to token j. */
INLINE void NAME(attend)(float *out, const float *split, int width, int heads) {
    float weights[TOKENS][TOKENS * MAX_HEADS] __attribute__((aligned(64))) = {{0}};
    const int size = width / heads;
    const float scale = 1.0f / sqrtf((float)size);
    for (int place = 0; place < heads * TOKENS; place++) {
        const float *first = split + place / TOKENS * size;
        const float *query = first + place % TOKENS * 3 * width;
        for (int j = 0; j < TOKENS; j++) {
            const float *key = first + (3 * j + 1) * width;
            VEC dot = ZERO();
            for (int k = 0; k < size; k += LANES) dot = FMA(LOAD(query + k), LOAD(key + k), dot);
            weights[j][place] = SUM(dot) * scale;
        }
    }
    for (int i = 0; i < heads * TOKENS; i += LANES) {
        VEC given[TOKENS], sum = ZERO();
        for (int j = 0; j < TOKENS; j++) given[j] = LOAD(weights[j] + i);
        const VEC most = MAX(given[0], MAX(given[1], given[2]));
        for (int j = 0; j < TOKENS; j++) {
            given[j] = NAME(exponential)(SUB(given[j], most));
            sum = ADD(sum, given[j]);
        }
        for (int j = 0; j < TOKENS; j++) STORE(weights[j] + i, DIV(given[j], sum));
    }
    for (int place = 0; place < heads * TOKENS; place++) {
        const float *first = split + place / TOKENS * size;
        float *mixed = out + place % TOKENS * width + place / TOKENS * size;
        for (int k = 0; k < size; k += LANES) {
            VEC sum = ZERO();
            for (int j = 0; j < TOKENS; j++)
                sum = FMA(SET1(weights[j][place]), LOAD(first + (3 * j + 2) * width + k), sum);
            STORE(mixed + k, sum);
        }
    }
}

#include "place.h"

/* Where a vector of a tile's outputs stands, and how its weights are read. In bfloat16 each word
   holds the weights of two outputs that are 16 apart: two cheap instructions make them floats. */
#define PLACE(v) ((v) * LANES)
#define PLACE_OF_PAIR(v) ((v) / (32 / LANES) * 32 + (v) / 2 % (16 / LANES) * LANES + (v) % 2 * 16)
#define LOAD_TWO(p, a, b) (a = LOAD_WEIGHT(p), b = LOAD_WEIGHT((p) + LANES))

#define WEIGHT float
#define FINE float
#define LOAD_WEIGHT LOAD
#define LOAD_FINE LOAD
#define LOAD_WEIGHTS LOAD_TWO
#define PLACE_OF PLACE
#define KIND(a) JOIN(NAME(a), full)
#include "products.h"
#include "rollout.h"
#include "encode.h"
#undef WEIGHT
#undef FINE
#undef LOAD_WEIGHT
#undef LOAD_FINE
#undef KIND

#define WEIGHT uint16_t
#define FINE uint16_t
#define LOAD_WEIGHT LOAD_HALF
#define LOAD_FINE LOAD_HALF
#define KIND(a) JOIN(NAME(a), half)
#include "products.h"
#include "rollout.h"
#undef FINE
#undef LOAD_WEIGHT
#undef LOAD_FINE
#undef LOAD_WEIGHTS
#undef PLACE_OF
#undef KIND

#define FINE float
#define LOAD_FINE LOAD
#define LOAD_WEIGHTS LOAD_PAIR
#define PLACE_OF PLACE_OF_PAIR
#define KIND(a) JOIN(NAME(a), brief)
#include "products.h"
#include "rollout.h"
#include "encode.h"
#undef WEIGHT
#undef FINE
#undef LOAD_FINE
#undef LOAD_WEIGHTS
#undef PLACE_OF
#undef KIND
#undef PLACE
#undef PLACE_OF_PAIR
#undef LOAD_TWO

#include "probe.h"

#undef SUFFIX
#undef TARGET
#undef LANES
#undef VEC
#undef ZERO
#undef SET1
#undef LOAD
#undef STORE
#undef LOAD_HALF
#undef LOAD_PAIR
#undef FMA
#undef ADD
#undef SUB
#undef MUL
#undef DIV
#undef MAX
#undef MIN
#undef SUM
#undef ROUND
#undef POWER_OF_2
#undef JOIN_
#undef JOIN
#undef NAME
#undef INLINE
