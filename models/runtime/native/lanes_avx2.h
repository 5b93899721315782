/* Eight floats at a time, for processors with AVX2, FMA and F16C. */
#define SUFFIX avx2
#define TARGET __attribute__((target("avx2,fma,f16c")))
#define LANES 8
#define VEC __m256
#define ZERO() _mm256_setzero_ps()
#define SET1(x) _mm256_set1_ps(x)
#define LOAD(p) _mm256_loadu_ps(p)
#define STORE(p, v) _mm256_storeu_ps(p, v)
#define LOAD_HALF(p) _mm256_cvtph_ps(_mm_loadu_si128((const __m128i *)(p)))
#define LOAD_PAIR(p, a, b) \
    do { \
        const __m256i pair_ = _mm256_loadu_si256((const __m256i *)(p)); \
        a = _mm256_castsi256_ps(_mm256_slli_epi32(pair_, 16)); \
        b = _mm256_castsi256_ps(_mm256_and_si256(pair_, _mm256_set1_epi32((int)0xffff0000))); \
    } while (0)
#define FMA(a, b, c) _mm256_fmadd_ps(a, b, c)
#define ADD(a, b) _mm256_add_ps(a, b)
#define SUB(a, b) _mm256_sub_ps(a, b)
#define MUL(a, b) _mm256_mul_ps(a, b)
#define DIV(a, b) _mm256_div_ps(a, b)
#define MAX(a, b) _mm256_max_ps(a, b)
#define MIN(a, b) _mm256_min_ps(a, b)
#define SUM(v) sum_of_8(v)
#define ROUND(v) _mm256_round_ps(v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)
#define POWER_OF_2(v) \
    _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(v), _mm256_set1_epi32(127)), 23))
