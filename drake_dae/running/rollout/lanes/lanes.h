/* real: the numbers of several runs side by side in a vector register, or that of one run.
   mask: for each of them, all bits if something holds, else none. */

#if defined(ONE_LANE) || defined(__CUDACC__)
#define LANES 1
#elif defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif

#if defined(__GNUC__) && !defined(__clang__) && !defined(__CUDACC__)
/* The order in which GCC then puts operations takes 7 per cent less time. */
#pragma GCC optimize("schedule-insns", "sched-pressure")
#endif

#ifdef __CUDACC__
#define ON_DEVICE __device__
#define APART __noinline__
#define CONSTANT static __device__ const
#ifndef NAN
#define NAN (0.0 / 0.0)
#endif
#else
#include <math.h>
#include <string.h>
#define ON_DEVICE
#define CONSTANT static const
#define APART __attribute__((noinline))
#endif
#define IN_LINE ON_DEVICE static inline

#if LANES == 1
typedef double real;
typedef long long mask;
#define LANE(values, lane) (values)
#define K(number) (number)
#define LESS(a, b) (-(mask)((a) < (b)))
#define NOT_MORE(a, b) (-(mask)((a) <= (b)))
#define SAME(a, b) (-(mask)((a) == (b)))
#define CHOOSE(condition, a, b) ((condition) ? (a) : (b))
#define ONE_IF(condition) ((condition) ? 1.0 : 0.0)
IN_LINE mask none(void) { return 0; }
IN_LINE int any(mask condition) { return condition != 0; }
IN_LINE real square_root(real x) { return sqrt(x); }
IN_LINE real magnitude(real x) { return fabs(x); }
IN_LINE real least(real a, real b) { return fmin(a, b); }
IN_LINE real most(real a, real b) { return fmax(a, b); }
IN_LINE void turn(real angle, real *sine, real *cosine) {
  *sine = sin(angle);
  *cosine = cos(angle);
}
#define EACH(name) \
  IN_LINE real each_##name(real x) { return name(x); }
#define EACH_OF_TWO(name) \
  IN_LINE real each_##name(real x, real y) { return name(x, y); }
#else
typedef double real __attribute__((vector_size(8 * LANES)));
typedef long long mask __attribute__((vector_size(8 * LANES)));
#define LANE(values, lane) ((values)[lane])
#if LANES == 8
#define K(number) ((real){number, number, number, number, number, number, number, number})
#elif LANES == 4
#define K(number) ((real){number, number, number, number})
#else
#define K(number) ((real){number, number})
#endif
#define LESS(a, b) ((mask)((a) < (b)))
#define NOT_MORE(a, b) ((mask)((a) <= (b)))
#define SAME(a, b) ((mask)((a) == (b)))
#define CHOOSE(condition, a, b) ((real)(((mask)(a) & (condition)) | ((mask)(b) & ~(condition))))
#define ONE_IF(condition) ((real)((mask)K(1.0) & (condition)))
#if LANES == 8
#include <immintrin.h>
IN_LINE int any(mask condition) {
  return _mm512_test_epi64_mask((__m512i)condition, (__m512i)condition) != 0;
}
IN_LINE real square_root(real x) { return (real)_mm512_sqrt_pd((__m512d)x); }
IN_LINE real rounded(real x) { return (real)_mm512_roundscale_pd((__m512d)x, 0); }
#elif LANES == 4
#include <immintrin.h>
IN_LINE int any(mask condition) { return _mm256_movemask_pd((__m256d)condition) != 0; }
IN_LINE real square_root(real x) { return (real)_mm256_sqrt_pd((__m256d)x); }
IN_LINE real rounded(real x) { return (real)_mm256_round_pd((__m256d)x, 0); }
#else
IN_LINE int any(mask condition) { return (condition[0] | condition[1]) != 0; }
IN_LINE real square_root(real x) { return (real){sqrt(x[0]), sqrt(x[1])}; }
IN_LINE real rounded(real x) { return (real){rint(x[0]), rint(x[1])}; }
#endif
IN_LINE mask none(void) { return (mask)K(0.0); }
IN_LINE real magnitude(real x) { return (real)((mask)x & ~(mask)K(-0.0)); }
/* Whether one of them is larger than a limit, or not a number. */
IN_LINE int has_more(real x, double limit) {
#if LANES == 8
  return _mm512_cmp_pd_mask((__m512d)magnitude(x), (__m512d)K(limit), _CMP_NLE_UQ) != 0;
#else
  return any(~NOT_MORE(magnitude(x), K(limit)));
#endif
}
/* Of a number and one that is not a number, the number, as fmin has it. */
IN_LINE real least(real a, real b) { return CHOOSE(LESS(a, b) | ~SAME(b, b), a, b); }
IN_LINE real most(real a, real b) { return CHOOSE(LESS(b, a) | ~SAME(b, b), a, b); }
#define EACH(name)                                                     \
  IN_LINE real each_##name(real x) {                                   \
    int lane;                                                          \
    for (lane = 0; lane < LANES; lane++) x[lane] = name(x[lane]);      \
    return x;                                                          \
  }
#define EACH_OF_TWO(name)                                              \
  IN_LINE real each_##name(real x, real y) {                           \
    int lane;                                                          \
    for (lane = 0; lane < LANES; lane++) x[lane] = name(x[lane], y[lane]); \
    return x;                                                          \
  }
EACH(sin)
EACH(cos)

/* Large angles, which no joint has, go one by one. */
static APART void turn_far(real angle, real *sine, real *cosine) {
  const mask far = LESS(K(1e5), magnitude(angle));
  *sine = CHOOSE(far, each_sin(angle), *sine);
  *cosine = CHOOSE(far, each_cos(angle), *cosine);
}

/* Sine and cosine to one unit in the last place: pi/2 taken away in three parts of 33 bits, and the
   polynomials of FreeBSD's msun up to pi/4. */
static inline __attribute__((always_inline)) void turn(real angle, real *sine, real *cosine) {
  const real n = rounded(angle * K(6.36619772367581382433e-01));
  const real a = angle - n * K(1.57079632673412561417e+00);
  const real b = n * K(6.07710050630396597660e-11), c = a - b;
  const real d = n * K(2.02226624879595063154e-21);
  const real x = c - d, y = ((a - c) - b) - (d - (c - x));
  const real z = x * x, w = z * z, v = z * x;
  const real p = K(8.33333333332248946124e-03) +
                 z * (K(-1.98412698298579493134e-04) + z * K(2.75573137070700676789e-06)) +
                 z * w * (K(-2.50507602534068634195e-08) + z * K(1.58969099521155010221e-10));
  const real s = x - ((z * (K(0.5) * y - v * p) - y) + v * K(1.66666666666666324348e-01));
  const real q = z * (K(4.16666666666666019037e-02) +
                      z * (K(-1.38888888888741095749e-03) + z * K(2.48015872894767294178e-05))) +
                 w * w * (K(-2.75573143513906633035e-07) +
                          z * (K(2.08757232129817482790e-09) + z * K(-1.13596475577881948265e-11)));
  const real half = K(0.5) * z, e = K(1.0) - half;
  const real t = e + (((K(1.0) - e) - half) + (z * q - x * y));
  /* n modulo 4 stands in the lowest bits of a number whose last bit is one. */
  const mask quarter = (mask)(n + K(6755399441055744.0)), odd = -(quarter & 1);
  *sine = (real)((mask)CHOOSE(odd, t, s) ^ (quarter >> 1 << 63));
  *cosine = (real)((mask)CHOOSE(odd, s, t) ^ ((quarter + 1) >> 1 << 63));
  if (has_more(angle, 1e5)) turn_far(angle, sine, cosine);
}
#endif

EACH(exp)
EACH(log)
EACH(tan)
EACH(asin)
EACH(acos)
EACH(atan)
EACH(sinh)
EACH(cosh)
EACH(tanh)
EACH(floor)
EACH(ceil)
EACH_OF_TWO(pow)
EACH_OF_TWO(atan2)
EACH_OF_TWO(copysign)

/* Where a number is finite. */
IN_LINE mask is_number(real x) { return SAME(x - x, K(0.0)); }

/* The number itself where it is zero, as CasADi has it. */
IN_LINE real sign(real x) {
  return CHOOSE(LESS(K(0.0), x), K(1.0), CHOOSE(LESS(x, K(0.0)), K(-1.0), x));
}
