/* See ${name}_$kind.h. What CasADi generated comes first, then what calls it. */

#ifdef __FAST_MATH__
#error "not with -ffast-math: nan would pass for a number"
#endif

$generated
#include <math.h>
#include <string.h>

#include "${name}_$kind.h"

enum {
  SIZE = ${guard}_${KIND}_STATES,
  HELD = $count_held,
  PARAMETERS = ${guard}_${KIND}_PARAMETERS,
  INPUTS = ${guard}_${KIND}_INPUTS,
  OUTPUTS = ${guard}_${KIND}_OUTPUTS,
  RATES = $count_rates,
  STAGES = $stages
};
enum { OK = ${guard}_${KIND}_OK, NO_VALUE = ${guard}_${KIND}_NO_VALUE };

/* The Runge-Kutta method. */
static const double a[STAGES][STAGES] = $method_a;
static const double b[STAGES] = $method_b;
static const double c[STAGES] = $method_c;

/* Periods and offsets of what is sampled, in s, and how near times are one. */
static const double periods[RATES + 1] = $periods;
static const double offsets[RATES + 1] = $offsets;
static const double NEAR = $near;

/* A Newton step to a state on N* after which what is left, its square, is round-off; and one after
   which those that follow are sure to reach. */
static const double REACHED = 1e-8, CLOSE = 1e-5;

$names
typedef ${prefix}_$kind Own;

/* Constants are copied one by one: in a memcpy gcc 12 with -mavx512f takes {5, 5, 0, 0, 0, 0, 0, 0}
   for eight times 5. */
static void copy(double *to, const volatile double *from, int size) {
  int i;
  for (i = 0; i < size; i++) to[i] = from[i];
}

static int are_finite(const double *vector, int size) {
  int i;
  for (i = 0; i < size; i++) {
    if (!isfinite(vector[i])) return 0;
  }
  return 1;
}

/* What the time, the parameters and the inputs alone determine. */
static void set_time(Own *own, double time) {
  if (time == own->given_time) return;
$given  own->given_time = time;
}

static int rates(Own *own, double time, const double *x, double *rate) {
  double valid = 0.0;
  (void)x;
  set_time(own, time);
$rate  return isfinite(valid) != 0;
}

/* The state on N*, by Newton steps. */
static int project(Own *own, double time) {
$project}

$updates
/* What is due at this time, all at once for each kind of update; the projection is between. */
static int update(Own *own) {
  double time = own->time, *held = own->held;
  int is_projected = 0, good = 1;
  (void)held;
  set_time(own, time);
  for (;;) {
    double earliest = INFINITY;
    int due[RATES + 1] = {0}, i, any = 0;
    for (i = 0; i < RATES; i++) {
      double moment = offsets[i] + (double)own->next[i] * periods[i];
      if (moment <= time + NEAR && moment < earliest) earliest = moment;
    }
    for (i = 0; i < RATES; i++) {
      due[i] = offsets[i] + (double)own->next[i] * periods[i] == earliest;
      any |= due[i];
    }
$unrestricted    if (!is_projected && !project(own, time)) return ${guard}_${KIND}_OFF_MANIFOLD;
    is_projected = 1;
    if (!any) break;
$discrete    for (i = 0; i < RATES; i++) own->next[i] += due[i];
    if (!good || !are_finite(own->held, HELD)) return NO_VALUE;
  }
  return OK;
}

/* One step of the method. */
static int step(Own *own, double end) {
  double k[STAGES][SIZE + 1], at[SIZE + 1], length = end - own->time;
  int i, j, s, good = 1;
  for (s = 0; s < STAGES; s++) {
    double sum[SIZE + 1] = {0.0};
    for (j = 0; j < s; j++) {
      if (a[s][j] == 0.0) continue;
      for (i = 0; i < SIZE; i++) sum[i] += a[s][j] * k[j][i];
    }
    for (i = 0; i < SIZE; i++) at[i] = own->state[i] + length * sum[i];
    good &= rates(own, own->time + c[s] * length, at, k[s]);
  }
  {
    double sum[SIZE + 1] = {0.0};
    for (j = 0; j < STAGES; j++) {
      if (b[j] == 0.0) continue;
      for (i = 0; i < SIZE; i++) sum[i] += b[j] * k[j][i];
    }
    for (i = 0; i < SIZE; i++) at[i] = own->state[i] + length * sum[i];
  }
  if (!good || !are_finite(at, SIZE)) return NO_VALUE;
  memcpy(own->state, at, sizeof(double) * SIZE);
  own->time = end;
  return OK;
}

/* What is held at first, where that depends on the start. */
static void begin(Own *own) {
  double time = own->time;
  int i;
  (void)time;
  if (own->has_begun) return;
  own->has_begun = 1;
$begin  for (i = 0; i < RATES; i++) {
    double count = ceil((own->time - offsets[i] - NEAR) / periods[i]);
    own->next[i] = count > 0.0 ? (long long)count : 0;
  }
}

void ${prefix}_${kind}_init(Own *own) {
  static const double parameters[] = $parameters;
  static const double state[] = $state;
  static const double held[] = $held;
  memset(own, 0, sizeof(*own));
  copy(own->parameters, parameters, PARAMETERS + INPUTS);
  copy(own->state, state, SIZE);
  copy(own->held, held, HELD);
  own->time = $start;
  own->longest = $longest;
  ${prefix}_${kind}_show(own);
  copy(own->held, held, HELD);
  own->has_begun = 0; /* At the first step, with the parameters and the state of then. */
}

int ${prefix}_${kind}_show(Own *own) {
  double valid = 0.0, time = own->time;
  own->given_time = NAN;
  begin(own);
  set_time(own, time);
$row  return isfinite(valid) ? OK : NO_VALUE;
}

int ${prefix}_${kind}_advance(Own *own, double time) {
  own->given_time = NAN;
  begin(own);
  while (own->time < time) {
    double end = time, from = own->time;
    long long i, count;
    int status = update(own);
    if (status) return status;
    for (i = 0; i < RATES; i++) {
      double moment = offsets[i] + (double)own->next[i] * periods[i];
      if (moment < end - NEAR) end = moment;
    }
    count = (long long)fmax(1.0, ceil((end - from) / own->longest - 0.01));
    for (i = 1; i <= count; i++) {
      double to = i < count ? from + (end - from) * ((double)i / (double)count) : end;
      if (i > 1 && !project(own, own->time)) return ${guard}_${KIND}_OFF_MANIFOLD;
      status = step(own, to);
      if (status) return status;
    }
  }
  return ${prefix}_${kind}_show(own);
}
