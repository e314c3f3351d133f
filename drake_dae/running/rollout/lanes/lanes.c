/* Many runs, LANES of them side by side. stepper.c continues runs that fail here, or need more than
   the usual Newton steps, from the last accepted state, and finds why a run fails. */

$header
$functions
$constants
/* As in stepper.c. */
#define REACHED K(1e-8)
#define NEAR K(1e-5)

$run
/* How a run ended; Python has the same list. */
enum { DONE, HANDED_OVER };

/* The largest number of rejected trials of a step. */
enum { TRIALS = 30 };

/* A value of `next` after Python was interrupted. */
#define STOPPED (1LL << 62)
#define IS_STOPPED(b) (*(b)->next >= STOPPED)

/* The arguments from Python. Arrays of runs have a row for each run; with a step of 0, one for all. */
typedef struct {
  long long num_runs;
  double *states, *held;    /* at the start, and then at the end */
  const double *parameters, *noise;
  long long parameter_step, noise_step;
  long long num_rows, num_events, stages;
  const double *times, *events;
  const long long *due;
  double *rows;
  double longest, relative;
  const double *a, *b, *c;  /* of fixed steps */
  const double *absolute;   /* of error control */
  const double *constants;  /* of the functions */
  Run *runs;
  int *endings;
  volatile long long *next; /* the first run that is not started yet */
} Batch;

/* Active runs, and the constants of a step. */
typedef struct {
  real x[SIZE], held[HELD + 1], parameters[PARAMETERS + 1], given[GIVEN + 1];
  real time; /* of `given` */
  const double *constants;
  mask far;  /* for which runs `given` has an angle that is too large */
  long long run[LANES], event[LANES];
} Lanes;

static void load(const Batch *b, Lanes *l, int lane, long long run) {
  int i;
  l->run[lane] = run;
  l->constants = b->constants;
  for (i = 0; i < SIZE; i++) l->x[i][lane] = b->states[run * SIZE + i];
  for (i = 0; i < HELD; i++) l->held[i][lane] = b->held[run * HELD + i];
  for (i = 0; i < PARAMETERS; i++) {
    l->parameters[i][lane] = b->parameters[run * b->parameter_step + i];
  }
  l->time[lane] = NAN;
  l->far[lane] = 0;
}

static void save(const Batch *b, const Lanes *l, int lane, const real *x, const real *held,
                           Run state, int ending) {
  long long run = l->run[lane];
  int i;
  for (i = 0; i < SIZE; i++) b->states[run * SIZE + i] = x[i][lane];
  for (i = 0; i < HELD; i++) b->held[run * HELD + i] = held[i][lane];
  b->runs[run] = state;
  b->endings[run] = ending;
}

static Run begun(const Batch *b) {
  Run run;
  memset(&run, 0, sizeof(run));
  run.time = run.start = run.mark = b->times[0];
  run.pending = ALL;
  return run;
}

/* Returns the number of the next run, or of the first of several. */
static long long take(const Batch *b, long long count) {
  return __atomic_fetch_add(b->next, count, __ATOMIC_RELAXED);
}

static void set_time(real time, Lanes *l) {
  if (!GIVEN || !any(~SAME(time, l->time))) return;
  l->far = dae_given(l->constants, &time, l->parameters, l->given);
  l->time = time;
}

/* Computes the derivative of the state; returns for which runs it has a value. */
static mask rates(real time, const real *x, Lanes *l, real *rate) {
  real valid;
  mask far;
  set_time(time, l);
  far = dae_rate(l->constants, &time, x, l->held, l->parameters, l->given, rate, &valid);
  return is_number(valid) & ~(far | l->far);
}

/* Projects some states onto N*; returns which are on it. */
static mask project(real time, real *x, Lanes *l, mask wanted) {
  real found[SIZE], at[SIZE], left;
  const real *from = x;
  mask open = wanted, near, far;
  int i, attempt;
  if (!PROJECTS || !any(wanted)) return wanted;
  set_time(time, l);
  for (attempt = 0; attempt < 8; attempt++) {
    far = dae_newton(l->constants, &time, from, l->held, l->parameters, l->given, found, &left);
    near = NOT_MORE(left, REACHED) & open & ~(far | l->far);
    for (i = 0; i < SIZE; i++) {
      at[i] = found[i];
      x[i] = CHOOSE(near, found[i], x[i]);
    }
    open &= ~near;
    if (!any(open) || (attempt && !any(open & NOT_MORE(left, NEAR)))) break;
    from = at;
  }
  return wanted & ~open;
}

/* Writes a row of the record for some runs; returns for which it has values. */
static mask write(const Batch *b, Lanes *l, mask wanted, real time, const real *x,
                            const long long *row) {
  real values[WIDTH + 1], valid;
  mask far;
  int i, lane;
  set_time(time, l);
  far = dae_row(l->constants, &time, x, l->held, l->parameters, l->given, values, &valid);
  wanted &= is_number(valid) & ~(far | l->far);
  for (lane = 0; lane < LANES; lane++) {
    double *into = b->rows + (l->run[lane] * b->num_rows + row[lane]) * WIDTH;
    if (!wanted[lane]) continue;
    for (i = 0; i < WIDTH; i++) into[i] = values[i][lane];
  }
  return wanted;
}

/* Returns which runs have an update of a rate now. */
static mask due(const Batch *b, const Lanes *l, mask now, int number) {
  int lane;
  for (lane = 0; lane < LANES; lane++) {
    if (now[lane]) now[lane] = -(b->due[l->event[lane]] >> number & 1);
  }
  return now;
}

/* Makes the updates of one kind that are due; returns for which runs they have values. */
static mask apply(const Batch *b, real time, Lanes *l, mask now, int unrestricted) {
  real fresh[HELD + 1], noise[NOISE + 1];
  mask good = now;
  int i, lane;
  (void)time, (void)unrestricted;
  if (!RATES || !any(now)) return now;
  set_time(time, l);
  for (i = 0; i < NOISE; i++) {
    noise[i] = K(0.0);
    for (lane = 0; lane < LANES; lane++) {
      if (!now[lane]) continue;
      noise[i][lane] = b->noise[l->run[lane] * b->noise_step + l->event[lane] * NOISE + i];
    }
  }
  memcpy(fresh, l->held, HELD * sizeof(real));
$updates
  memcpy(l->held, fresh, HELD * sizeof(real));
  return good;
}

/* Makes one instant of updates and the projection; returns for which runs this succeeds. */
static mask update(const Batch *b, real time, Lanes *l, mask to_project, mask now) {
  mask good = apply(b, time, l, now, 1) | ~now;
  good &= project(time, l->x, l, to_project) | ~to_project;
  return good & (apply(b, time, l, now, 0) | ~now);
}

/* Returns which runs have samples at their time. */
static mask sampled(const Batch *b, const Lanes *l, mask wanted, const Run *run) {
  int lane;
  (void)l;
  for (lane = 0; lane < LANES; lane++) {
    long long event = run[lane].event;
    if (event >= b->num_events || b->events[event] > run[lane].time) wanted[lane] = 0;
  }
  return wanted;
}

/* Makes all updates and the projection at the start of a step; returns for which runs this succeeds. */
static mask updates(const Batch *b, real time, Lanes *l, mask wanted, mask to_project,
                              Run *run, mask *changed) {
  mask good = wanted, now = none();
  int lane;
  if (RATES) now = sampled(b, l, wanted, run);
  *changed = now;
  if (!any(now)) return good & (project(time, l->x, l, to_project) | ~to_project);
  for (;;) {
    for (lane = 0; lane < LANES; lane++) l->event[lane] = run[lane].event;
    good &= update(b, time, l, to_project & good, now & good);
    if (!any(now)) return good;
    for (lane = 0; lane < LANES; lane++) run[lane].event += now[lane] != 0;
    now = sampled(b, l, now & good, run);
    to_project = none();
  }
}

/* reached = x + step * weighted sum of rates; most weights of a high order are zero. */
static void weigh(real step, int count, const double *b, const real *x, real (*k)[SIZE],
                            real *reached) {
  real weights[16];
  const real *used[16];
  int i, j, number = 0;
  for (j = 0; j < count; j++) {
    if (b[j] == 0.0) continue;
    weights[number] = step * K(b[j]);
    used[number++] = k[j];
  }
  for (i = 0; i < SIZE; i++) {
    real sum = x[i];
    for (j = 0; j < number; j++) sum += weights[j] * used[j][i];
    reached[i] = sum;
  }
}

$fixed
$controlled
/* Called by Python, from any number of threads at once. */
__attribute__((visibility("default"))) void run_lanes(const Batch *b) {
  long long first;
  if (!b->stages) {
    run_apart(b);
    return;
  }
  while ((first = take(b, LANES)) < b->num_runs) run_together(b, first);
}
