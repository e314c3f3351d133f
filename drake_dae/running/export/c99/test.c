/* Compares $name.c with values that Python computed, to 1e-12 of the size of each vector: its largest
   entry, or what it changes by with its inputs where that is more, as for a difference of large
   numbers. So another libm, whose last bits differ, passes. */

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "$name.h"

$data
static double worst = 0.0;

static int differs(const char *what, int sample, int size, const double *found,
                   const double *wanted, double scale) {
  int i;
  for (i = 0; i < size; i++) {
    double off = fabs(found[i] - wanted[i]);
    if (!(off <= 1e-12 * scale)) {
      printf("%s[%d] of sample %d is %.17g, and Python has %.17g\n", what, i, sample, found[i],
             wanted[i]);
      return 1;
    }
    if (scale > 0.0 && off / scale > worst) worst = off / scale;
  }
  return 0;
}

static int refused(const char *what, int sample, int result) {
  if (result) printf("${prefix}_%s of sample %d returns %d\n", what, sample, result);
  return result != 0;
}

/* What is not a number must be told; -ffast-math, for one, takes it for one. */
static int takes_nan(void) {
  double state[${guard}_STATE_SIZE + 1], control[${guard}_CONTROL_SIZE + 1];
  double rate[${guard}_STATE_SIZE + 1], force[${guard}_CONSTRAINT_FORCE_SIZE + 1];
  double output[${guard}_CONTROLLED_OUTPUT_SIZE + 1];
  int i;
  for (i = 0; i <= ${guard}_STATE_SIZE; i++) state[i] = NAN;
  for (i = 0; i <= ${guard}_CONTROL_SIZE; i++) control[i] = NAN;
  if (${prefix}_plant(state, control, ${prefix}_default_parameters, rate, force, output)) return 0;
  printf("${prefix}_plant takes nan\n");
  return 1;
}

int main(void) {
  int failures = takes_nan(), k;
$checks
  if (failures) {
    printf("FAILED: %d differences\n", failures);
    return 1;
  }
  printf("passed: $count samples, at most %.1e off\n", worst);
  return 0;
}
