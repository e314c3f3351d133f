/* Plays a run that Drake's Simulator made to the controller of $name, compares, and takes the time.

       play_$name [${name}_run.csv]

   A line of the file has the time, all inputs, and the outputs that follow. */

#define _POSIX_C_SOURCE 199309L

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "${name}_controller.h"

enum { INPUTS = ${guard}_CONTROLLER_INPUTS, OUTPUTS = ${guard}_CONTROLLER_OUTPUTS };
enum { WIDTH = 1 + INPUTS + OUTPUTS, CALLS = 1000000 };

/* Relative to the largest entry of a vector in the run. What an observer holds, and a direction of
   friction that depends on a sign, may pass on the last bit of another libm for many steps. */
static const double TOLERANCE = 1e-9;

static const struct { const char *name; int size; } outputs[] = $output_sizes;

static double *rows;
static int count;

static void fill(const double *row, ${prefix}_controller_inputs *in) {
  in->time = in->measured_at = row[0];
  row++;
$filled}

static void read_out(const ${prefix}_controller_outputs *out, double *row) {
$shown}

static int load(const char *path) {
  FILE *file = fopen(path, "r");
  int capacity = 0, c;
  if (!file) {
    printf("%s: cannot be read\n", path);
    return 0;
  }
  while ((c = fgetc(file)) != '\n') { /* The names. */
    if (c == EOF) break;
  }
  for (;;) {
    int i;
    if (count == capacity) {
      capacity = capacity ? 2 * capacity : 1024;
      rows = (double *)realloc(rows, sizeof(double) * WIDTH * (size_t)capacity);
      if (!rows) return 0;
    }
    for (i = 0; i < WIDTH; i++) {
      double *place = rows + (size_t)count * WIDTH + i;
      if (fscanf(file, i ? ",%lf" : "%lf", place) != 1) break;
    }
    if (i < WIDTH) {
      fclose(file);
      if (i || !count) printf("%s: line %d has %d numbers, not %d\n", path, count + 2, i, WIDTH);
      return !i && count > 0;
    }
    count++;
  }
}

static int compare(void) {
  ${prefix}_controller controller;
  ${prefix}_controller_inputs in;
  ${prefix}_controller_outputs out;
  double scale[OUTPUTS] = {0.0}, found[OUTPUTS], worst = 0.0;
  int k, i, j, place, failures = 0;
  for (k = 0; k < count; k++) {
    for (i = j = 0; i < OUTPUTS; j++) {
      double largest = 0.0;
      for (place = i; i < place + outputs[j].size; i++) {
        largest = fmax(largest, fabs(rows[(size_t)k * WIDTH + 1 + INPUTS + i]));
      }
      for (i = place; i < place + outputs[j].size; i++) scale[i] = fmax(scale[i], largest);
    }
  }
  ${prefix}_controller_init(&controller);
  for (k = 0; k < count; k++) {
    const double *row = rows + (size_t)k * WIDTH;
    fill(row, &in);
    if (${prefix}_controller_step(&controller, &in, &out) != ${guard}_RUNNING) {
      printf("line %d: status %d, fault %d\n", k + 2, out.status, out.fault);
      return 1;
    }
    read_out(&out, found);
    for (i = j = 0; i < OUTPUTS && failures < 10; j++) {
      for (place = i; i < place + outputs[j].size; i++) {
        double wanted = row[1 + INPUTS + i], off = fabs(found[i] - wanted);
        if (!(off <= TOLERANCE * scale[i])) {
          printf("%s[%d] in line %d is %.17g, and Drake has %.17g\n", outputs[j].name, i - place,
                 k + 2, found[i], wanted);
          failures++;
        } else if (scale[i] > 0.0 && off / scale[i] > worst) {
          worst = off / scale[i];
        }
      }
    }
  }
  if (failures) return 1;
  printf("played: %d steps as in Drake, at most %.1e of the largest off\n", count, worst);
  return 0;
}

static int wrong(const char *what, const ${prefix}_controller_outputs *out) {
  int i, bad = 0;
  for (i = 0; i < ${guard}_CONTROLLER_CONTROLS; i++) bad |= !isfinite(out->control[i]);
  if (bad) printf("%s: the control is not finite\n", what);
  return bad;
}

/* A good start, then what is wrong for ever: first it holds, then it stops, at stop_control. */
static int drill(const char *what, int fault) {
  ${prefix}_controller controller;
  ${prefix}_controller_inputs in;
  ${prefix}_controller_outputs out;
  double time = 0.0;
  int k, i, holds = 0, made_up = 0, good = count < 20 ? count : 20;
  ${prefix}_controller_init(&controller);
  for (k = 0; k < good; k++) {
    fill(rows + (size_t)k * WIDTH, &in);
    ${prefix}_controller_step(&controller, &in, &out);
    time = in.time;
  }
  for (k = 1; k < 100000 && out.control[0] != controller.stop_control[0]; k++) {
    in.time = in.measured_at = time + k * ${guard}_CONTROLLER_PERIOD;
    if (fault == ${guard}_FAULT_NUMBER) ((double *)&in)[2 + k % INPUTS] = k % 2 ? NAN : INFINITY;
    if (fault == ${guard}_FAULT_STALE) in.measured_at = time;
    if (fault == ${guard}_FAULT_LATE) {
      in.time += controller.patience * ${guard}_CONTROLLER_PERIOD + (k > 1 ? k : 0.0);
      in.measured_at = in.time;
    }
    ${prefix}_controller_step(&controller, &in, &out);
    if (wrong(what, &out)) return 1;
    holds += out.status == ${guard}_HOLDING;
    made_up += out.status == ${guard}_RUNNING && out.fault == ${guard}_FAULT_LATE;
    if (out.status == ${guard}_STOPPED && out.fault != fault) break;
  }
  for (i = 0; i < ${guard}_CONTROLLER_CONTROLS; i++) {
    if (out.status == ${guard}_STOPPED && out.control[i] == controller.stop_control[i]) continue;
    printf("%s: status %d, fault %d, control[%d] = %g\n", what, out.status, out.fault, i,
           out.control[i]);
    return 1;
  }
  if (made_up) {
    printf("%s: made up for %d steps, then stopped\n", what, controller.patience);
  } else {
    printf("%s: held for %d steps, then stopped\n", what, holds);
  }
  if (holds + made_up) return 0;
  printf("%s: stopped at once\n", what);
  return 1;
}

#ifdef CLOCK_MONOTONIC
static int by_size(const void *a, const void *b) {
  double x = *(const float *)a, y = *(const float *)b;
  return (x > y) - (x < y);
}

static void take_time(void) {
  static float times[CALLS];
  ${prefix}_controller controller;
  ${prefix}_controller_inputs in;
  ${prefix}_controller_outputs out;
  double sum = 0.0;
  int k;
  for (k = 0; k < CALLS; k++) {
    struct timespec begin, end;
    if (k % count == 0) ${prefix}_controller_init(&controller);
    fill(rows + (size_t)(k % count) * WIDTH, &in);
    clock_gettime(CLOCK_MONOTONIC, &begin);
    ${prefix}_controller_step(&controller, &in, &out);
    clock_gettime(CLOCK_MONOTONIC, &end);
    sum += out.control[0];
    times[k] = (float)((end.tv_sec - begin.tv_sec) * 1e6 + (end.tv_nsec - begin.tv_nsec) * 1e-3);
  }
  qsort(times, CALLS, sizeof(times[0]), by_size);
  printf("a step: %.3g us in the median, %.3g us at the 99.9th percentile, %.3g us at most, of %d"
         " calls\n", times[CALLS / 2], times[CALLS - CALLS / 1000], times[CALLS - 1], CALLS);
  if (!isfinite(sum)) printf("not finite\n");
}
#else
static void take_time(void) {}
#endif

int main(int argc, char **argv) {
  int failures;
  if (!load(argc > 1 ? argv[1] : "${name}_run.csv")) return 1;
  failures = compare();
  failures += drill("not a number", ${guard}_FAULT_NUMBER);
  failures += drill("a stale measurement", ${guard}_FAULT_STALE);
  failures += drill("missed deadlines", ${guard}_FAULT_LATE);
  if (failures) {
    printf("FAILED\n");
    return 1;
  }
  take_time();
  return 0;
}
