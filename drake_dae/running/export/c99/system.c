/* See $name.h. What CasADi generated comes first, then what calls it. */

#ifdef __FAST_MATH__
#error "not with -ffast-math: nan would pass for a number"
#endif

$generated
#include <math.h>
#include <string.h>

#include "$name.h"

$names
/* Whether the values of a function are of use: it computes a number that is finite exactly if they
   all are, and the pivot of what must be regular, which is small also where an input is not finite. */
static int status(double pivot, double finite, int count, const double *const *inputs,
                  const int *sizes) {
  int i, k;
  if (isfinite(finite) && pivot >= 1e-12) return ${guard}_OK;
  for (k = 0; k < count; k++) {
    for (i = 0; i < sizes[k]; i++) {
      if (!(fabs(inputs[k][i]) < 1e30)) return ${guard}_NOT_FINITE;
    }
  }
  return isfinite(finite) || pivot < 1e-12 ? ${guard}_SINGULAR : ${guard}_NOT_FINITE;
}

$calls
static double norm(const double *vector, const double *unit) {
  double sum = 0.0;
  int i;
  for (i = 0; i < ${guard}_STATE_SIZE; i++) {
    double entry = unit ? vector[i] / unit[i] : vector[i];
    sum += entry * entry;
  }
  return sqrt(sum);
}

static void move(const double *from, double length, const double *step, double *to) {
  int i;
  for (i = 0; i < ${guard}_STATE_SIZE; i++) to[i] = from[i] + length * step[i];
}

int ${prefix}_project(double *state, const double *parameters) {
  /* A step must make the next one, by the same matrix, shorter; steps are measured relative to the
     start, or to 1 where that is larger. */
  double x[${guard}_STATE_SIZE], trial[${guard}_STATE_SIZE], unit[${guard}_STATE_SIZE];
  double step[${guard}_STATE_SIZE], next[${guard}_STATE_SIZE], residual[$residuals];
  double size, left, length;
  int iteration, i, halvings;
  for (i = 0; i < ${guard}_STATE_SIZE; i++) {
    x[i] = state[i];
    unit[i] = fmax(1.0, fabs(state[i]));
  }
  for (iteration = 0; iteration < 200; iteration++) {
    newton_step(x, x, parameters, step);
    size = norm(step, unit);
    if (size <= 1e-15) {
      memcpy(trial, x, sizeof(x));
      memcpy(next, step, sizeof(step));
      break;
    }
    for (halvings = 0, length = 1.0; halvings < 30; halvings++, length *= 0.5) {
      move(x, length, step, trial);
      newton_step(trial, x, parameters, next);
      left = norm(next, unit);
      if (left * left <= 1e-16 * size || left <= (1.0 - 0.25 * length) * size) break;
    }
    if (halvings == 30) {
      if (!isfinite(size)) return ${guard}_NOT_FINITE;
      if (size > 1e-8) return ${guard}_NOT_CONVERGED;
      memcpy(state, x, sizeof(x)); /* What is left is round-off. */
      return ${guard}_OK;
    }
    if (left * left <= 1e-16 * size) break;
    memcpy(x, trial, sizeof(x));
  }
  if (iteration == 200) return ${guard}_NOT_CONVERGED;
  /* The steps that follow, by the matrix of x, until they are round-off. */
  for (size = norm(next, 0); size > 0.0; size = left) {
    move(trial, 1.0, next, trial);
    newton_step(trial, x, parameters, next);
    left = norm(next, 0);
    if (!(left < 0.5 * size)) break;
  }
  if (size == 0.0) { /* Nothing is left, or what no state changes. */
    if (${prefix}_residual(trial, parameters, residual)) return ${guard}_NOT_FINITE;
    for (i = 0, left = 0.0; i < ${guard}_CONSTRAINT_RESIDUAL_SIZE; i++) {
      left += residual[i] * residual[i];
    }
    if (sqrt(left) > 1e-8) return ${guard}_NOT_CONVERGED;
  }
  memcpy(state, trial, sizeof(trial));
  return ${guard}_OK;
}
