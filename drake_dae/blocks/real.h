/* real: a number, or those of LANES runs side by side in a vector register.
   mask: for each of them, all bits if something holds, else none. */

#ifndef LANES
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
#endif

#include <math.h>
#include <string.h>
#define IN_LINE static inline

#if LANES == 1
typedef double real;
typedef long long mask;
#define AT(vector, lane) (vector)
#define K(number) (number)
#define LESS(a, b) (-(mask)((a) < (b)))
#define NOT_MORE(a, b) (-(mask)((a) <= (b)))
#define SAME(a, b) (-(mask)((a) == (b)))
#define CHOOSE(condition, a, b) ((condition) ? (a) : (b))
#define CHOOSE_MASK(condition, a, b) CHOOSE(condition, a, b)
IN_LINE int any(mask condition) { return condition != 0; }
IN_LINE mask none(void) { return 0; }
IN_LINE real square_root(real x) { return sqrt(x); }
IN_LINE real magnitude(real x) { return fabs(x); }
IN_LINE real least(real a, real b) { return fmin(a, b); }
IN_LINE real most(real a, real b) { return fmax(a, b); }
IN_LINE mask is_number(real x) { return -(mask)(isfinite(x) != 0); }
#else
#define APART __attribute__((noinline))
#define AT(vector, lane) ((vector)[lane])
#if defined(__GNUC__) && !defined(__clang__)
/* The order in which GCC then puts operations takes 7 per cent less time. */
#pragma GCC optimize("schedule-insns", "sched-pressure")
#endif

typedef double real __attribute__((vector_size(8 * LANES)));
typedef long long mask __attribute__((vector_size(8 * LANES)));
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
#define CHOOSE_MASK(condition, a, b) (((a) & (condition)) | ((b) & ~(condition)))
#define ONE_IF(condition) ((real)((mask)K(1.0) & (condition)))
#if LANES == 8
#include <immintrin.h>
IN_LINE int any(mask condition) {
  return _mm512_test_epi64_mask((__m512i)condition, (__m512i)condition) != 0;
}
IN_LINE real square_root(real x) { return (real)_mm512_sqrt_pd((__m512d)x); }
IN_LINE real rounded(real x) { return (real)_mm512_roundscale_pd((__m512d)x, 0); }
IN_LINE real less_product(real a, real n, real p) {
  return (real)_mm512_fnmadd_pd((__m512d)n, (__m512d)p, (__m512d)a);
}
#elif LANES == 4
#include <immintrin.h>
IN_LINE int any(mask condition) { return _mm256_movemask_pd((__m256d)condition) != 0; }
IN_LINE real square_root(real x) { return (real)_mm256_sqrt_pd((__m256d)x); }
IN_LINE real rounded(real x) { return (real)_mm256_round_pd((__m256d)x, 0); }
#ifdef __FMA__
IN_LINE real less_product(real a, real n, real p) {
  return (real)_mm256_fnmadd_pd((__m256d)n, (__m256d)p, (__m256d)a);
}
#endif
#else
IN_LINE int any(mask condition) { return (condition[0] | condition[1]) != 0; }
IN_LINE real square_root(real x) { return (real){sqrt(x[0]), sqrt(x[1])}; }
IN_LINE real rounded(real x) { return (real){rint(x[0]), rint(x[1])}; }
#endif
IN_LINE mask none(void) { return (mask)K(0.0); }
IN_LINE real magnitude(real x) { return (real)((mask)x & ~(mask)K(-0.0)); }
/* A square root and one over it. With AVX-512, Newton's method from 14 bits takes less time than the
   instructions. As with them, the root is the nearest number, and the other one is off by 1.5 units
   in the last place at most. */
static inline __attribute__((always_inline)) void root(real x, real *value, real *over) {
#if LANES == 8
  const real first = (real)_mm512_rsqrt14_pd((__m512d)x), half = K(0.5);
  real r = x * first, h = half * first, left = half - r * h;
  r += r * left;
  h += h * left;
  left = half - r * h;
  r += r * left;
  h += h * left;
  r += h * (x - r * r);
  /* For 0 and infinity. */
  *value = CHOOSE(SAME(x + x, x), x, r);
  *over = CHOOSE(SAME(x + x, x), first, h + h);
#else
  *value = square_root(x);
  *over = K(1.0) / *value;
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

/* Sine and cosine to one unit in the last place, for angles up to 5e8; returns which are larger. As
   many pi/2 are taken away as fit, in parts of which products with up to 29 bits are exact, and
   then come the polynomials of FreeBSD's msun up to pi/4. */
static inline __attribute__((always_inline)) mask turn(real angle, real *sine, real *cosine) {
  const real n = rounded(angle * K(6.36619772367581382433e-01));
#ifdef __FMA__
  const real a = less_product(angle, n, K(1.57079632679489655800e+00));
  const real b = n * K(6.12323360118134922981e-17), c = a - b;
  const real d = n * K(3.94555416656320550661e-24);
#else
  const real a = (angle - n * K(1.57079625129699707031e+00)) - n * K(7.54978941586159635335e-08);
  const real b = n * K(5.39030252995776476554e-15), c = a - b;
  const real d = n * K(3.28200354287350047444e-22);
#endif
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
  return LESS(K(5e8), magnitude(angle));
}

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
#endif
