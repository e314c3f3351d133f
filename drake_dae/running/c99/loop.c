/* See ${name}_loop.h. First come the functions that CasADi generated and the stepper of rollouts, then
   what calls them. */

#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#define CASADI_CODEGEN_PREFIX ${prefix}_loop_
#define CODEGEN_PREFIX ${prefix}_loop_
#define make_runs ${prefix}_make_runs
$stepper
#pragma GCC diagnostic pop

#include "${name}_loop.h"

enum { MANY = 64 }; /* updates in a call of the stepper */

/* The Runge-Kutta method. */
static const double a[] = $method_a;
static const double b[] = $method_b;
static const double c[] = $method_c;

/* Periods and offsets of what is sampled, in s. */
static const double periods[] = $periods;
static const double offsets[] = $offsets;

const char *const ${prefix}_loop_parameter_names[] = $parameter_names;
const char *const ${prefix}_loop_parameter_units[] = $parameter_units;

typedef ${prefix}_loop Loop;

/* Constants are copied one by one: in a memcpy gcc 12 with -mavx512f takes {5, 5, 0, 0, 0, 0, 0, 0}
   for eight times 5. */
static void copy(double *to, const volatile double *from, int size) {
  int i;
  for (i = 0; i < size; i++) to[i] = from[i];
}

static double moment(const Loop *l, int rate) {
  return offsets[rate] + (double)l->next[rate] * periods[rate];
}

/* What is held at first, and which updates come first, with the parameters and the state of then. */
static void begin_run(Loop *l) {
  double held[HELD + 1];
  int i;
  (void)held;
  l->has_begun = 1;
$begin  for (i = 0; i < RATES; i++) {
    l->next[i] = (long long)fmax(0.0, ceil((l->time - offsets[i]) / periods[i] - 1e-9));
  }
}

/* The next updates up to a time, and which rates are due at each, as bits. */
static long long next_updates(Loop *l, double time, double *moments, long long *due) {
  long long count;
  int i;
  for (count = 0; count < MANY; count++) {
    double earliest = INFINITY;
    for (i = 0; i < RATES; i++) earliest = fmin(earliest, moment(l, i));
    if (!(earliest <= time)) break;
    moments[count] = fmax(earliest, l->time);
    due[count] = 0;
    for (i = 0; i < RATES; i++) {
      if (moment(l, i) != earliest) continue;
      due[count] |= 1LL << i;
      l->next[i]++;
    }
  }
  return count;
}

void ${prefix}_loop_init(Loop *l) {
  static const double parameters[] = $parameters;
  static const double state[] = $state;
  static const double held[] = $held;
  memset(l, 0, sizeof(*l));
  copy(l->parameters, parameters, PARAMETERS);
  copy(l->state, state, ${guard}_LOOP_STATES);
  copy(l->held, held, HELD);
  l->time = $start;
  l->longest = $longest;
}

int ${prefix}_loop_advance(Loop *l, double time) {
  if (l->has_begun && time <= l->time) return ${guard}_OK;
  if (!l->has_begun) begin_run(l);
  for (;;) {
    double moments[MANY], end = time;
    long long due[MANY], first = 0;
    Run run;
    Batch batch;
    memset(&run, 0, sizeof(run));
    memset(&batch, 0, sizeof(batch));
    batch.num_events = next_updates(l, time, moments, due);
    if (batch.num_events == MANY) end = moments[MANY - 1];
    run.time = run.start = run.mark = l->time;
    batch.num_runs = batch.num_rows = 1;
    batch.states = l->state, batch.held = l->held, batch.parameters = l->parameters;
    batch.times = &end, batch.events = moments, batch.due = due;
    batch.rows = (double *)&l->outputs;
    batch.longest = l->longest;
    batch.stages = $stages;
    batch.a = a, batch.b = b, batch.c = c;
    batch.runs = &run;
    batch.budget = 1LL << 62;
    batch.next = &first;
    make_runs(&batch);
    l->time = run.time;
    if (run.ending == OFF_MANIFOLD) return ${guard}_OFF_MANIFOLD;
    if (run.ending != DONE) return ${guard}_NO_VALUE;
    if (end >= time) return ${guard}_OK;
  }
}

#ifdef __wasm__
/* In a page there is one. */
static Loop page;
#define SHOWN(name) __attribute__((export_name(name)))
SHOWN("init") void page_init(void) { ${prefix}_loop_init(&page); }
SHOWN("advance") int page_advance(double time) { return ${prefix}_loop_advance(&page, time); }
SHOWN("time") double page_time(void) { return page.time; }
SHOWN("parameters") double *page_parameters(void) { return page.parameters; }
SHOWN("outputs") double *page_outputs(void) { return (double *)&page.outputs; }
#endif
