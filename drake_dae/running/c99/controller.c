/* See ${name}_controller.h. What CasADi generated comes first, then what calls it. */

#ifdef __FAST_MATH__
#error "not with -ffast-math: nan would pass for a number"
#endif

#define CASADI_CODEGEN_PREFIX ${prefix}_controller_
#define CODEGEN_PREFIX ${prefix}_controller_
#define CASADI_SYMBOL_EXPORT static
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
$generated
#pragma GCC diagnostic pop

#include <math.h>
#include <string.h>

#include "${name}_controller.h"

enum {
  HELD = ${guard}_CONTROLLER_HELD,
  PARAMETERS = ${guard}_CONTROLLER_PARAMETERS,
  INPUTS = ${guard}_CONTROLLER_INPUTS,
  OUTPUTS = ${guard}_CONTROLLER_OUTPUTS,
  CONTROLS = ${guard}_CONTROLLER_CONTROLS
};

static const double PERIOD = ${guard}_CONTROLLER_PERIOD;
static const long long FIRST = $first; /* tick of a run */

const char *const ${prefix}_controller_parameter_names[] = $parameter_names;
const char *const ${prefix}_controller_parameter_units[] = $parameter_units;

typedef ${prefix}_controller Controller;
typedef int Generated(const double **, double **, casadi_int *, double *, int);

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

static void evaluate(Generated *f, const Controller *c, double time, const double *held,
                     double *value) {
  const double *arg[] = {&time, 0, held, c->parameters, 0}; /* No state, and no noise. */
  double *res[] = {value};
  f(arg, res, 0, 0, 0);
}

/* One step with the last good inputs; 0 where the law has no value, and all stays as it is. */
static int run(Controller *c, long long tick) {
  double time = (double)tick * PERIOD, held[HELD + 1], before[HELD + 1], row[OUTPUTS];
  memcpy(held, c->held, sizeof(held));
  (void)before; /* Where nothing is sampled. */
$steps  if (!are_numbers(held, HELD) || !are_numbers(row, OUTPUTS)) return 0;
  memcpy(c->held, held, sizeof(held));
  memcpy(c->row, row, sizeof(row));
  return 1;
}

static void stop(Controller *c, int fault) {
  c->status = ${guard}_STOPPED;
  c->fault = fault;
  c->stopping = 0.0;
}

static int put(const Controller *c, ${prefix}_controller_outputs *out) {
  double share = c->stopping < c->stop_time ? c->stopping / c->stop_time : 1.0;
  int i;
  memcpy(out, c->row, sizeof(c->row)); /* The outputs come first, and of these the control. */
  for (i = 0; i < CONTROLS; i++) {
    double goal = c->stop_control[i];
    if (c->status == ${guard}_STOPPED) out->control[i] += share * (goal - out->control[i]);
    if (c->status == ${guard}_WAITING) out->control[i] = goal;
  }
  out->status = c->status;
  out->fault = c->fault;
  out->bad_steps = c->bad_steps;
  return c->status;
}

static const double first_held[] = $held;

void ${prefix}_controller_init(Controller *c) {
  static const double parameters[] = $parameters;
  memset(c, 0, sizeof(*c));
  copy(c->parameters, parameters, PARAMETERS);
  copy(c->held, first_held, HELD);
  c->stop_time = 0.1;
  c->max_age = 1.5 * PERIOD;
  c->patience = 10;
  c->status = ${guard}_WAITING;
}

/* What is held at first, with the first good inputs. */
static int begin(Controller *c) {
$begin  return are_numbers(c->held, HELD);
}

int ${prefix}_controller_step(Controller *c, const ${prefix}_controller_inputs *in,
                              ${prefix}_controller_outputs *out) {
  double given[2 + INPUTS]; /* time, measured_at, and what was measured */
  long long now, last;
  int fault = ${guard}_NO_FAULT;
  memcpy(given, in, sizeof(given));
  if (!are_numbers(given + 2, INPUTS)) fault = ${guard}_FAULT_NUMBER;
  if (!(in->time - in->measured_at <= c->max_age)) fault = ${guard}_FAULT_STALE;
  if (!(fabs(in->time) < 1e15 * PERIOD)) fault = ${guard}_FAULT_CLOCK;
  if (c->status == ${guard}_WAITING) {
    c->fault = fault;
    if (fault) return put(c, out);
    c->zero = in->time;
    c->tick = FIRST - 1;
    memcpy(c->parameters + PARAMETERS, given + 2, sizeof(double) * INPUTS);
    if (!begin(c)) { /* As if there had been no inputs. */
      copy(c->held, first_held, HELD);
      c->fault = ${guard}_FAULT_VALUE;
      return put(c, out);
    }
    c->status = ${guard}_RUNNING;
  }
  last = c->tick;
  now = last + 1; /* As if in time, where the clock is of no use. */
  if (fault != ${guard}_FAULT_CLOCK) {
    double passed = floor((in->time - c->zero) / PERIOD + 0.5);
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
  if (now - last > 1) {
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
  if (!fault) memcpy(c->parameters + PARAMETERS, given + 2, sizeof(double) * INPUTS);
  if (!run(c, now) && !fault) fault = c->fault = ${guard}_FAULT_VALUE;
  c->bad_steps = fault ? c->bad_steps + 1 : 0;
  c->status = fault ? ${guard}_HOLDING : ${guard}_RUNNING;
  if (c->bad_steps > c->patience) stop(c, fault);
  return put(c, out);
}
