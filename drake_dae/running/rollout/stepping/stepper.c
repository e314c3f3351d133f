/* The steps of a diagram: functions that CasADi generated, constants of this diagram, the steppers. */

#ifdef __FAST_MATH__
#error "not with -ffast-math: nan would pass for a number"
#endif
#define CASADI_SYMBOL_EXPORT static

$generated
#include <math.h>
#include <string.h>

$constants
/* After a Newton step of length REACHED, the error is its square, which is round-off. After one of
   length NEAR, further steps are sure to converge. */
static const double REACHED = 1e-8, NEAR = 1e-5;

/* How a call ended; Python has the same list. */
enum { DONE, PAUSED, INVALID, OFF_MANIFOLD, STUCK, SPOILT, SLOW };

$run
/* Constants of a step, and functions of the time alone. */
typedef struct {
  const double *held, *parameters;
  double given[GIVEN + 1];
  double time; /* of `given`; nan before the first */
} Given;

static int is_finite(const double *vector, int size) {
  int i;
  for (i = 0; i < size; i++) {
    if (!isfinite(vector[i])) return 0;
  }
  return 1;
}

/* A row, the last stage of a step and the first of the next one are at the same time. */
static void set_time(double time, Given *g) {
  const double *arg[GIVEN_ARG] = {&time, g->parameters};
  double *res[GIVEN_RES] = {g->given};
  if (!GIVEN || time == g->time) return;
  dae_given(arg, res, 0, 0, 0);
  g->time = time;
}

/* Computes the derivative of the state; returns 0, and nan, if it has no value. */
static int rates(double time, const double *x, Given *g, double *rate) {
  double valid;
  const double *arg[RATE_ARG] = {&time, x, g->held, g->parameters, g->given};
  double *res[RATE_RES] = {rate, &valid};
  int i, good;
  set_time(time, g);
  dae_rate(arg, res, 0, 0, 0);
  good = isfinite(valid) != 0;
  for (i = 0; !good && i < SIZE; i++) rate[i] = NAN;
  return good;
}

/* Computes a row of the record; returns 0 if it has no value. */
static int write(double time, const double *x, Given *g, double *row) {
  double valid;
  const double *arg[ROW_ARG] = {&time, x, g->held, g->parameters, g->given};
  double *res[ROW_RES] = {row, &valid};
  set_time(time, g);
  dae_row(arg, res, 0, 0, 0);
  return isfinite(valid) != 0;
}

/* Projects the state onto N* by Newton steps; returns 0 if Python has to decide. */
static int project(double time, double *x, Given *g) {
  double at[SIZE + 1], found[SIZE + 1], left;
  const double *arg[NEWTON_ARG] = {&time, at, g->held, g->parameters, g->given};
  double *res[NEWTON_RES] = {found, &left};
  int attempt;
  if (!PROJECTS) return 1;
  set_time(time, g);
  memcpy(at, x, SIZE * sizeof(double));
  for (attempt = 0; attempt < 8; attempt++) {
    dae_newton(arg, res, 0, 0, 0);
    if (left <= REACHED) {
      memcpy(x, found, SIZE * sizeof(double));
      return 1;
    }
    if (attempt && !(left <= NEAR)) return 0;
    memcpy(at, found, SIZE * sizeof(double));
  }
  return 0;
}

/* Makes the updates of one kind that are due, all at once; returns 0 if one has no value. */
static int apply(double time, const double *x, double *held, Given *g, const double *noise,
                 long long due, int unrestricted) {
  double fresh[HELD + 1];
  int good = 1;
  (void)time, (void)x, (void)noise, (void)due, (void)unrestricted;
  set_time(time, g);
  memcpy(fresh, held, HELD * sizeof(double));
$updates
  if (good) memcpy(held, fresh, HELD * sizeof(double)); /* Else Python needs the old ones, to report why. */
  return good;
}

$sample/* Projects the state and makes the updates that are due, at the start of a step. */
static int update(Run *run, double *x, double *held, Given *g, long long num_events,
                  const double *events, const long long *due, const double *noise) {
  while (run->pending) {
    int now = run->event < num_events && events[run->event] <= run->time;
    const double *drawn = noise + run->event * NOISE;
    if (run->pending & UNRESTRICTED) {
      if (now && !apply(run->time, x, held, g, drawn, due[run->event], 1)) return INVALID;
      run->pending &= ~UNRESTRICTED;
    }
    if (run->pending & PROJECTION) {
      if (!project(run->time, x, g)) return OFF_MANIFOLD;
      run->pending &= ~PROJECTION;
    }
    if (now && !apply(run->time, x, held, g, drawn, due[run->event], 0)) return INVALID;
    run->pending = now ? UNRESTRICTED | DISCRETE : 0;
    run->event += now;
  }
  return DONE;
}

/* Accepts a step; ends the run where a thousand steps add hardly any time. */
static int accept(Run *run, double time, double *x, const double *reached) {
  memcpy(x, reached, SIZE * sizeof(double));
  run->time = time;
  run->failures = 0;
  run->pending = ALL;
  if (++run->steps % 1000 == 0) {
    run->before = run->mark;
    run->mark = time;
    if (time - run->before < 1e-8 * (time - run->start)) return SLOW;
  }
  return DONE;
}

static void note(Run *run, double time, const double *x, double *trial) {
  if (run->failures++ && time >= run->trial) return;
  if (!is_finite(x, SIZE)) return; /* It follows from another failure. */
  run->trial = time;
  memcpy(trial, x, SIZE * sizeof(double));
}

/* reached = x + step * weighted sum of rates; most weights of a high order are zero. */
static void weigh(double step, int count, const double *b, const double *x, double (*k)[SIZE],
                  double *reached) {
  double sum[SIZE] = {0.0};
  int i, j;
  for (j = 0; j < count; j++) {
    if (b[j] == 0.0) continue;
    for (i = 0; i < SIZE; i++) sum[i] += b[j] * k[j][i];
  }
  for (i = 0; i < SIZE; i++) reached[i] = x[i] + step * sum[i];
}

/* Computes the rate at a stage of an explicit Runge-Kutta method. */
static void stage(Run *run, double time, double step, int count, const double *a, double c,
                  const double *x, Given *g, double (*k)[SIZE], double *trial) {
  double at[SIZE];
  weigh(step, count, a, x, k, at);
  if (!rates(time + c * step, at, g, k[count])) note(run, time + c * step, at, trial);
}

/* Fixed steps; their number divides the time between two rows or samples. */
__attribute__((visibility("default"))) int run_fixed(
    Run *run, double *x, double *held, const double *parameters, double *trial, long long num_rows,
    const double *times, double *rows, long long num_events, const double *events,
    const long long *due, const double *noise, double longest, int stages, const double *a,
    const double *b, const double *c, long long budget) {
  Given g;
  double k[16][SIZE], reached[SIZE];
  int s, status;
  g.held = held;
  g.parameters = parameters;
  g.time = NAN;
  for (;;) {
    double end, step;
    if (run->row < num_rows && run->time >= times[run->row]) {
      if (run->row == num_rows - 1) {
        status = update(run, x, held, &g, num_events, events, due, noise);
        if (status != DONE) return status;
      }
      if (!write(run->time, x, &g, rows + run->row * WIDTH)) return INVALID;
      run->row++;
    }
    if (run->row == num_rows) return DONE;
    if (budget-- == 0) return PAUSED;
    status = update(run, x, held, &g, num_events, events, due, noise);
    if (status != DONE) return status;
    end = times[run->row];
    if (run->event < num_events && events[run->event] < end) end = events[run->event];
    if (run->index == run->number) {
      run->from = run->time;
      run->index = 0;
      run->number = (long long)fmax(1.0, ceil((end - run->from) / longest - 0.01));
    }
    run->index++;
    if (run->index < run->number) {
      end = run->from + (end - run->from) * ((double)run->index / (double)run->number);
    }
    step = end - run->time;
    if (!rates(run->time, x, &g, k[0])) return INVALID;
    for (s = 1; s < stages; s++) stage(run, run->time, step, s, a + s * stages, c[s], x, &g, k, trial);
    weigh(step, stages, b, x, k, reached);
    run->next = end;
    if (!is_finite(reached, SIZE)) return SPOILT;
    status = accept(run, end, x, reached);
    if (status != DONE) return status;
  }
}

static double weighted(const double *vector, const double *unit) {
  double sum = 0.0;
  int i;
  for (i = 0; i < SIZE; i++) sum += vector[i] / unit[i] * (vector[i] / unit[i]);
  return sqrt(sum / SIZE);
}

/* A first step, as SciPy finds it (Hairer, Norsett and Wanner, section II.4). */
static double first_step(Run *run, const double *x, const double *rate, const double *absolute,
                         double relative, double longest, Given *g) {
  double unit[SIZE], other[SIZE], change[SIZE], d0, d1, d2, h0, h1;
  int i;
  for (i = 0; i < SIZE; i++) unit[i] = absolute[i] + fabs(x[i]) * relative;
  d0 = weighted(x, unit), d1 = weighted(rate, unit);
  h0 = fmin(d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1, longest);
  for (i = 0; i < SIZE; i++) other[i] = x[i] + h0 * rate[i];
  if (!rates(run->time + h0, other, g, change)) return fmin(h0, longest);
  for (i = 0; i < SIZE; i++) change[i] -= rate[i];
  d2 = weighted(change, unit) / h0;
  h1 = d1 <= 1e-15 && d2 <= 1e-15 ? fmax(1e-6, h0 * 1e-3) : pow(0.01 / fmax(d1, d2), 1.0 / 8.0);
  return fmin(fmin(100.0 * h0, h1), longest);
}

static double error_of(double step, const double *x, const double *reached, double (*k)[SIZE],
                       const double *absolute, double relative) {
  double fifth = 0.0, third = 0.0, e5[SIZE] = {0.0}, e3[SIZE] = {0.0};
  int i, j;
  for (j = 0; j < 12; j++) {
    for (i = 0; i < SIZE; i++) {
      e5[i] += dop_e5[j] * k[j][i];
      e3[i] += dop_e3[j] * k[j][i];
    }
  }
  for (i = 0; i < SIZE; i++) {
    double unit = absolute[i] + fmax(fabs(x[i]), fabs(reached[i])) * relative;
    fifth += e5[i] / unit * (e5[i] / unit);
    third += e3[i] / unit * (e3[i] / unit);
  }
  if (fifth == 0.0 && third == 0.0) return 0.0;
  return step * fifth / sqrt((fifth + 0.01 * third) * SIZE);
}

/* Error control by DOP853 as SciPy has it; rows between steps from its interpolant, on N*. */
__attribute__((visibility("default"))) int run_controlled(
    Run *run, double *x, double *held, const double *parameters, double *trial, long long num_rows,
    const double *times, double *rows, long long num_events, const double *events,
    const long long *due, const double *noise, double longest, const double *absolute,
    double relative, long long budget) {
  Given g;
  double k[16][SIZE], reached[SIZE], f[7][SIZE], between[SIZE];
  int i, j, s, status, valid, known = 0, is_on = 0;
  g.held = held;
  g.parameters = parameters;
  g.time = NAN;
  while (run->row < num_rows && run->time >= times[run->row]) {
    if (run->row == num_rows - 1) {
      status = update(run, x, held, &g, num_events, events, due, noise);
      if (status != DONE) return status;
    }
    if (!write(run->time, x, &g, rows + run->row * WIDTH)) return INVALID;
    run->row++;
  }
  for (;;) {
    double limit, error = 0.0, size;
    long long event = run->event;
    int rejected = 0;
    if (run->row == num_rows) return DONE;
    if (budget-- == 0) return PAUSED;
    status = update(run, x, held, &g, num_events, events, due, noise);
    if (status != DONE) return status;
    if (known && event == run->event) {
      memcpy(k[0], k[12], sizeof(k[0])); /* The rate at the end of the last step. */
    } else if (!rates(run->time, x, &g, k[0])) {
      return INVALID;
    }
    limit = times[num_rows - 1];
    if (run->event < num_events && events[run->event] < limit) limit = events[run->event];
    if (run->step == 0.0) {
      run->step = first_step(run, x, k[0], absolute, relative, longest, &g);
    }
    size = fmin(run->step, longest);
    for (;;) {
      double end = run->time + size, factor;
      if (end >= limit - 1e-12 * fabs(limit)) end = limit;
      size = end - run->time;
      if (!(size > 1e-12 * fabs(run->time)) || run->failures >= 1000) return STUCK;
      for (s = 1; s < 12; s++) stage(run, run->time, size, s, dop_a[s], dop_c[s], x, &g, k, trial);
      weigh(size, 12, dop_b, x, k, reached);
      error = error_of(size, x, reached, k, absolute, relative);
      valid = isfinite(error) != 0;
      factor = error == 0.0 ? 10.0 : fmin(10.0, fmax(0.2, 0.9 * pow(error, -1.0 / 8.0)));
      if (valid && error < 1.0) {
        is_on = project(end, reached, &g);
        valid = rates(end, reached, &g, k[12]);
        if (!valid) note(run, end, reached, trial);
      }
      if (valid && error < 1.0) {
        /* A step that only ended early, at a sample, says nothing against longer ones. */
        run->step = rejected ? size * fmin(1.0, factor)
                             : fmax(size * factor, size < run->step ? run->step : 0.0);
        limit = end;
        break;
      }
      rejected = 1;
      size *= valid ? factor : 0.2;
    }
    run->next = limit;
    if (times[run->row] <= limit) {
      for (s = 13; s < 16; s++) {
        stage(run, run->time, size, s, dop_a_more[s - 13], dop_c_more[s - 13], x, &g, k, trial);
      }
      for (i = 0; i < SIZE; i++) {
        f[0][i] = reached[i] - x[i];
        f[1][i] = size * k[0][i] - f[0][i];
        f[2][i] = 2.0 * f[0][i] - size * (k[12][i] + k[0][i]);
        for (j = 0; j < 4; j++) {
          f[3 + j][i] = 0.0;
          for (s = 0; s < 16; s++) f[3 + j][i] += dop_d[j][s] * k[s][i];
          f[3 + j][i] *= size;
        }
      }
    }
    while (run->row < num_rows && times[run->row] <= limit) {
      double time = times[run->row], part = (time - run->time) / size;
      if (time == limit) break; /* The step itself, below. */
      for (i = 0; i < SIZE; i++) {
        between[i] = 0.0;
        for (j = 6; j >= 0; j--) between[i] = (between[i] + f[j][i]) * (j % 2 ? 1.0 - part : part);
        between[i] += x[i];
      }
      project(time, between, &g);
      if (!write(time, between, &g, rows + run->row * WIDTH)) {
        run->failures = 0;
        note(run, time, between, trial);
        return INVALID;
      }
      run->row++;
    }
    status = accept(run, limit, x, reached);
    if (status != DONE) return status;
    if (is_on) run->pending &= ~PROJECTION; /* It is on N* already. */
    known = is_on;
    if (run->row < num_rows && times[run->row] == limit) {
      if (run->row == num_rows - 1) {
        status = update(run, x, held, &g, num_events, events, due, noise);
        if (status != DONE) return status;
      } else if (!is_on) {
        return OFF_MANIFOLD;
      }
      if (!write(limit, x, &g, rows + run->row * WIDTH)) return INVALID;
      run->row++;
    }
  }
}
