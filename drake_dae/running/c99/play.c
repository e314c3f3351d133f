/* Plays a run that Drake's Simulator made to the $kind of $name, compares, and takes the time.

       play_${name}_$kind [${name}_${kind}_run.csv]

   A line of the file has the time, all inputs, and the outputs that follow. */

#define _POSIX_C_SOURCE 199309L

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "${name}_$kind.h"

enum { INPUTS = $num_inputs, OUTPUTS = $num_outputs };
enum { WIDTH = 1 + INPUTS + OUTPUTS, MOST = $most, CALLS = $calls };

/* Relative to the largest entry of a vector in the run. What an observer holds, and a direction of
   friction that depends on a sign, may pass on the last bit of another libm for many steps. */
static const double TOLERANCE = 1e-9;

/* A smaller vector, as what is zero on N* (4), is compared with this. */
static const double ROUND_OFF = 1e-3;

static const struct { const char *name; int size; } outputs[] = $output_sizes;

static double rows[MOST + 1][WIDTH];
static int count;
static ${prefix}_$kind own;

static int load(const char *path) {
  FILE *file = fopen(path, "r");
  int i = 0, c;
  if (!file) {
    printf("%s: cannot be read\n", path);
    return 0;
  }
  while ((c = fgetc(file)) != '\n' && c != EOF) continue; /* The names. */
  for (; count <= MOST; count++) {
    for (i = 0; i < WIDTH && fscanf(file, i ? ",%lf" : "%lf", &rows[count][i]) == 1; i++) continue;
    if (i < WIDTH) break;
  }
  fclose(file);
  if (i || !count) printf("%s: line %d has %d numbers, not %d\n", path, count + 2, i, WIDTH);
  return !i && count > 0;
}
$step
/* The largest entry of a vector in the run. */
static double size_of(int first, int size) {
  double largest = 0.0;
  int k, i;
  for (k = 0; k < count; k++) {
    for (i = first; i < first + size; i++) largest = fmax(largest, fabs(rows[k][1 + INPUTS + i]));
  }
  return largest;
}

static int compare(void) {
  double scale[OUTPUTS], found[OUTPUTS], worst = 0.0;
  int k, i, j, place, failures = 0;
  for (i = j = 0; i < OUTPUTS; j++) {
    double largest = size_of(i, outputs[j].size);
    for (place = i; i < place + outputs[j].size; i++) scale[i] = largest;
  }
  for (k = 0; k < count; k++) {
    if (step(k, found)) {
      printf("line %d: a step fails\n", k + 2);
      return 1;
    }
    for (i = j = 0; i < OUTPUTS && failures < 10; j++) {
      for (place = i; i < place + outputs[j].size; i++) {
        double wanted = rows[k][1 + INPUTS + i], off = fabs(found[i] - wanted);
        if (!(off <= TOLERANCE * fmax(scale[i], ROUND_OFF))) {
          printf("%s[%d] in line %d is %.17g, and Drake has %.17g\n", outputs[j].name, i - place,
                 k + 2, found[i], wanted);
          failures++;
        } else {
          worst = fmax(worst, off / fmax(scale[i], ROUND_OFF));
        }
      }
    }
  }
  if (!failures) printf("played: %d steps as in Drake, at most %.1e of the largest off\n", count, worst);
  return failures;
}

static int by_size(const void *a, const void *b) {
  float x = *(const float *)a, y = *(const float *)b;
  return (x > y) - (x < y);
}

static void take_time(void) {
  static float times[CALLS];
  double found[OUTPUTS];
  int k;
  for (k = 0; k < CALLS; k++) {
    struct timespec begin, end;
    if (k % count == 0) ${prefix}_${kind}_init(&own);
    clock_gettime(CLOCK_MONOTONIC, &begin);
    step(k % count, found);
    clock_gettime(CLOCK_MONOTONIC, &end);
    times[k] = (float)((end.tv_sec - begin.tv_sec) * 1e6 + (end.tv_nsec - begin.tv_nsec) * 1e-3);
  }
  qsort(times, CALLS, sizeof(times[0]), by_size);
  printf("a step: %.3g us in the median, %.3g us at the 99.9th percentile, %.3g us at most, of %d"
         " calls\n", times[CALLS / 2], times[CALLS - CALLS / 1000], times[CALLS - 1], CALLS);
}

int main(int argc, char **argv) {
  if (!load(argc > 1 ? argv[1] : "${name}_${kind}_run.csv")) return 1;
  ${prefix}_${kind}_init(&own);
  if (compare()) {
    printf("FAILED\n");
    return 1;
  }
  take_time();
  return 0;
}
