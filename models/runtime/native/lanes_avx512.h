/* Sixteen floats at a time, for processors with AVX-512. */
#define SUFFIX avx512
#define TARGET __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma,f16c")))
#define LANES 16
#define VEC __m512
#define ZERO() _mm512_setzero_ps()
#define SET1(x) _mm512_set1_ps(x)
#define LOAD(p) _mm512_loadu_ps(p)
#define STORE(p, v) _mm512_storeu_ps(p, v)
#define LOAD_HALF(p) _mm512_cvtph_ps(_mm256_loadu_si256((const __m256i *)(p)))
/* 32 weights of bfloat16, as float the first and the second half of them: see `pack.py` */
#define LOAD_PAIR(p, a, b) \
    do { \
        const __m512i pair_ = _mm512_loadu_si512((const void *)(p)); \
        a = _mm512_castsi512_ps(_mm512_slli_epi32(pair_, 16)); \
        b = _mm512_castsi512_ps(_mm512_and_si512(pair_, _mm512_set1_epi32((int)0xffff0000))); \
    } while (0)
#define FMA(a, b, c) _mm512_fmadd_ps(a, b, c)
#define ADD(a, b) _mm512_add_ps(a, b)
#define SUB(a, b) _mm512_sub_ps(a, b)
#define MUL(a, b) _mm512_mul_ps(a, b)
#define DIV(a, b) _mm512_div_ps(a, b)
/* the second operand comes through where the first is not a number */
#define MAX(a, b) _mm512_max_ps(a, b)
#define MIN(a, b) _mm512_min_ps(a, b)
#define SUM(v) _mm512_reduce_add_ps(v)
#define ROUND(v) _mm512_roundscale_ps(v, 0)
/* 2 to the power of a whole number between -126 and 127 */
#define POWER_OF_2(v) \
    _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_add_epi32(_mm512_cvtps_epi32(v), _mm512_set1_epi32(127)), 23))
