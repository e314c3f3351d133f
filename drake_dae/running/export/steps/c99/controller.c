/* See ${name}_controller.h. What CasADi generated comes first, then what calls it. */

#ifdef __FAST_MATH__
#error "not with -ffast-math: nan would pass for a number"
#endif

$generated
#include <math.h>
#include <string.h>

#include "${name}_controller.h"

enum {
  HELD = $count_held,
  PARAMETERS = ${guard}_CONTROLLER_PARAMETERS,
  INPUTS = ${guard}_CONTROLLER_INPUTS,
  OUTPUTS = ${guard}_CONTROLLER_OUTPUTS,
  CONTROLS = ${guard}_CONTROLLER_CONTROLS
};

static const double PERIOD = ${guard}_CONTROLLER_PERIOD;
static const long long FIRST = $first; /* tick of a run */

$names
typedef ${prefix}_controller Controller;

/* Constants are copied one by one: in a memcpy gcc 12 with -mavx512f takes {5, 5, 0, 0, 0, 0, 0, 0}
   for eight times 5. */
static void copy(double *to, const volatile double *from, int size) {
  int i;
  for (i = 0; i < size; i++) to[i] = from[i];
}

static int are_numbers(const double *vector, int size) {
  int i, good = 1;
  for (i = 0; i < size; i++) good &= fabs(vector[i]) < 1e30;
  return good;
}

static int is_due(long long tick, long long every, long long first) {
  return tick >= first && (tick - first) % every == 0;
}

/* What the time and the inputs alone determine. */
static void set_time(Controller *c, double time) {
$given}

/* All outputs; 0 where they have no value. */
static int show(Controller *c, double time, const double *held, double *row) {
  double valid = 0.0;
$row  return isfinite(valid) && are_numbers(row, OUTPUTS);
}

$updates
/* What is held at first. */
static int begin(Controller *c) {
  double time = $start, held[HELD + 1];
  memcpy(held, c->held, sizeof(double) * HELD);
  (void)time;
  set_time(c, time);
$begin  return are_numbers(c->held, HELD);
}

/* One step with the last good inputs; 0 where the law has no value, and all stays as it is. */
static int run(Controller *c, long long tick) {
  double time = (double)tick * PERIOD, held[HELD + 1], row[OUTPUTS];
  int good = 1;
$time  set_time(c, time);
  memcpy(held, c->held, sizeof(double) * HELD);
  held[HELD] = 0.0;
  (void)is_due; /* Where nothing is sampled. */
$steps  if (!good || !are_numbers(held, HELD)) return 0;
  memcpy(c->held, held, sizeof(double) * HELD);
  memcpy(c->row, row, sizeof(row));
  memcpy(c->control, row, sizeof(c->control)); /* It comes first. */
  return 1;
}

static void stop(Controller *c, int fault) {
  c->status = ${guard}_STOPPED;
  c->fault = fault;
  c->stopping = 0.0;
}

static int put(const Controller *c, ${prefix}_controller_outputs *out) {
  const double *row = c->row;
  int i;
  (void)row; /* Where there are no other outputs. */
$written  for (i = 0; i < CONTROLS; i++) {
    double share = c->stopping < c->stop_time ? c->stopping / c->stop_time : 1.0;
    double goal = c->stop_control[i];
    out->control[i] = c->control[i];
    if (c->status == ${guard}_STOPPED) out->control[i] += share * (goal - c->control[i]);
    if (c->status == ${guard}_WAITING) out->control[i] = goal;
  }
  out->status = c->status;
  out->fault = c->fault;
  out->bad_steps = c->bad_steps;
  return c->status;
}

void ${prefix}_controller_init(Controller *c) {
  static const double parameters[] = $parameters;
  static const double held[] = $held;
  memset(c, 0, sizeof(*c));
  copy(c->parameters, parameters, PARAMETERS);
  copy(c->held, held, HELD);
  c->stop_time = 0.1;
  c->max_age = 1.5 * PERIOD;
  c->patience = 10;
  c->status = ${guard}_WAITING;
}

int ${prefix}_controller_step(Controller *c, const ${prefix}_controller_inputs *in,
                              ${prefix}_controller_outputs *out) {
  double fresh[INPUTS + 1], passed;
  long long now, last;
  int fault = ${guard}_NO_FAULT;
$gathered  if (!are_numbers(fresh, INPUTS)) fault = ${guard}_FAULT_NUMBER;
  if (!(in->time - in->measured_at <= c->max_age)) fault = ${guard}_FAULT_STALE;
  if (!(fabs(in->time) < 1e15 * PERIOD)) fault = ${guard}_FAULT_CLOCK;
  if (c->status == ${guard}_WAITING) {
    c->fault = fault;
    if (fault) return put(c, out);
    c->zero = in->time;
    c->tick = FIRST - 1;
    memcpy(c->parameters + PARAMETERS, fresh, sizeof(double) * INPUTS);
    if (!begin(c)) { /* As if there had been no inputs. */
      static const double held[] = $held;
      copy(c->held, held, HELD);
      c->fault = ${guard}_FAULT_VALUE;
      return put(c, out);
    }
    c->status = ${guard}_RUNNING;
  }
  last = c->tick;
  now = last + 1; /* As if in time, where the clock is of no use. */
  if (fault != ${guard}_FAULT_CLOCK) {
    passed = floor((in->time - c->zero) / PERIOD + 0.5);
    if (FIRST + (long long)passed < last) {
      fault = ${guard}_FAULT_CLOCK;
    } else {
      now = FIRST + (long long)passed;
    }
  }
  if (now == last) return put(c, out);
  c->tick = now;
  if (c->status == ${guard}_STOPPED) {
    c->stopping += PERIOD * (double)(now - last);
    return put(c, out);
  }
  c->fault = fault;
  if (now - last - 1 > 0) {
    if (!fault) c->fault = ${guard}_FAULT_LATE;
    if (now - last - 1 > c->patience - c->bad_steps) {
      stop(c, ${guard}_FAULT_LATE);
      return put(c, out);
    }
    for (last++; last < now; last++) {
      run(c, last);
      c->bad_steps++;
    }
  }
  if (!fault) memcpy(c->parameters + PARAMETERS, fresh, sizeof(double) * INPUTS);
  if (!run(c, now) && !fault) fault = c->fault = ${guard}_FAULT_VALUE;
  c->bad_steps = fault ? c->bad_steps + 1 : 0;
  c->status = fault ? ${guard}_HOLDING : ${guard}_RUNNING;
  if (c->bad_steps > c->patience) stop(c, fault);
  return put(c, out);
}
