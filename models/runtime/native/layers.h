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

/* Dot products of three tokens with each other, softmax, weighted sums; `split` holds each token's
   query, key and value one after the other. */
INLINE void NAME(attend)(float *out, const float *split, int width, int heads) {
    float weights[MAX_HEADS][TOKENS][16] __attribute__((aligned(64))) = {0};
    const int size = width / heads;
    const float scale = 1.0f / sqrtf((float)size);
    for (int head = 0; head < heads; head++) {
        const float *first = split + head * size;
        for (int i = 0; i < TOKENS; i++) {
            for (int j = 0; j < TOKENS; j++) {
                const float *query = first + i * 3 * width, *key = first + (3 * j + 1) * width;
                VEC dot = ZERO();
                for (int k = 0; k < size; k += LANES) dot = FMA(LOAD(query + k), LOAD(key + k), dot);
                weights[head][i][j] = SUM(dot) * scale;
            }
            NAME(softmax)(weights[head][i], TOKENS);
        }
        for (int i = 0; i < TOKENS; i++) {
            for (int k = 0; k < size; k += LANES) {
                VEC sum = ZERO();
                for (int j = 0; j < TOKENS; j++)
                    sum = FMA(SET1(weights[head][i][j]), LOAD(first + (3 * j + 2) * width + k), sum);
                STORE(out + i * width + head * size + k, sum);
            }
        }
    }
}

#define WEIGHT float
#define LOAD_WEIGHT LOAD
#define KIND(a) JOIN(NAME(a), full)
#include "products.h"
#include "rollout.h"
#include "encode.h"
#undef WEIGHT
#undef LOAD_WEIGHT
#undef KIND

#define WEIGHT uint16_t
#define LOAD_WEIGHT LOAD_HALF
#define KIND(a) JOIN(NAME(a), half)
#include "products.h"
#include "rollout.h"
#undef WEIGHT
#undef LOAD_WEIGHT
#undef KIND

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
