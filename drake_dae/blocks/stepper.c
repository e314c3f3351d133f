/* The steps of a block, of one run or of LANES runs side by side.

   Python writes in front of this file the sizes of the block, its functions dae_rate, dae_row,
   dae_newton and update_rate, and real.h. Each run has its own time and step. A run that fails is
   saved as it was before the step that failed; of several side by side it then goes on alone. */

/* After a Newton step of length REACHED, the error is its square, which is round-off. After one of
   length NEAR, further steps are sure to converge. */
#define REACHED K(1e-8)
#define NEAR K(1e-5)

/* How a run ended; Python has the same list. */
enum { DONE, PAUSED, INVALID, OFF_MANIFOLD, STUCK, SPOILT, SLOW };

/* The most trials of a step: ten shorter ones reduce it to round-off. Of runs side by side, one that
   needs more goes on alone. */
enum { TRIALS = LANES == 1 ? 1000 : 30 };

/* A value of `next` after which no run starts, and all end. */
#define STOPPED (1LL << 62)

/* A run, which can be stopped at any step and go on. */
typedef struct {
  double time, step;       /* the state is accepted at this time; what step to try next, 0 if none */
  double start, mark;      /* of the run, and after its last thousand steps */
  double from;             /* where a row of fixed steps began, to its end */
  long long row, event;    /* which come next */
  long long steps;         /* that were accepted */
  long long number, index; /* of fixed steps in this row, and which comes next */
  long long on;            /* whether the accepted state is projected already */
  long long ending;
} Run;

/* The arguments. Arrays of runs have a row for each run; with a step of 0, one for all. */
typedef struct {
  long long num_runs;
  double *states, *held;    /* at the start, and then at the end */
  const double *parameters, *noise;
  long long parameter_step, noise_step;
  long long num_rows, num_events;
  const double *times, *events;
  const long long *due;     /* the rates of each event, as bits */
  double *rows;
  double longest, relative;
  const double *absolute;   /* of error control */
  long long stages;         /* of fixed steps; 0 for error control by DOP853 */
  const double *a, *b, *c;
  const double *e3, *e5, *d, *a_more, *c_more; /* of DOP853, as SciPy has them */
  const double *constants;  /* of the functions */
  Run *runs;
  long long budget;         /* of steps in this call */
  volatile long long *next; /* the first run that is not taken yet */
} Batch;

typedef struct {
  real x[SIZE], held[HELD + 1], parameters[PARAMETERS + 1];
  real k[16][SIZE];                /* the rates at the stages, and at the end */
  real x_before[SIZE], held_before[HELD + 1];
  real time, size, limit, end;
  mask alive, begins, known;       /* known: k[12] is the rate at the accepted state */
  Run run[LANES], before[LANES];   /* now, and before this step */
  long long number[LANES];         /* of the run */
  int trials[LANES], rejected[LANES];
  const Batch *batch;
} Lanes;

static mask are_numbers(const real *values, int size) {
  real sum = K(0.0);
  int i;
  for (i = 0; i < size; i++) sum += values[i];
  return is_number(sum);
}

static void load(const Batch *b, Lanes *l, int lane, long long number) {
  int i;
  l->number[lane] = number;
  for (i = 0; i < SIZE; i++) AT(l->x[i], lane) = b->states[number * SIZE + i];
  for (i = 0; i < HELD; i++) AT(l->held[i], lane) = b->held[number * HELD + i];
  for (i = 0; i < PARAMETERS; i++) {
    AT(l->parameters[i], lane) = b->parameters[number * b->parameter_step + i];
  }
  l->run[lane] = b->runs[number];
  AT(l->known, lane) = 0;
}

static void save(Lanes *l, int lane, int ending, int is_before) {
  const Batch *b = l->batch;
  const real *x = is_before ? l->x_before : l->x, *held = is_before ? l->held_before : l->held;
  const long long number = l->number[lane];
  Run run = is_before ? l->before[lane] : l->run[lane];
  int i;
  for (i = 0; i < SIZE; i++) b->states[number * SIZE + i] = AT(x[i], lane);
  for (i = 0; i < HELD; i++) b->held[number * HELD + i] = AT(held[i], lane);
  run.ending = ending;
  b->runs[number] = run;
  AT(l->alive, lane) = 0;
}

/* Ends some runs, as they were before the step. */
static void fail(Lanes *l, mask some, int ending) {
  int lane;
  some &= l->alive;
  if (!any(some)) return;
  for (lane = 0; lane < LANES; lane++) {
    if (AT(some, lane)) save(l, lane, ending, 1);
  }
}

/* Computes the derivative of the state; returns for which runs it has a value. */
static mask rates(Lanes *l, real time, const real *x, real *rate) {
  const mask far = dae_rate(l->batch->constants, &time, x, l->held, l->parameters, rate);
  return are_numbers(rate, SIZE) & ~far;
}

/* Projects some states onto N* by Newton steps; returns which are on it. */
static mask project(Lanes *l, real time, real *x, mask wanted) {
  real found[SIZE], at[SIZE], left;
  const real *from = x;
  mask open = wanted, near, far;
  int i, attempt;
  if (!PROJECTS || !any(wanted)) return wanted;
  for (attempt = 0; attempt < 8; attempt++) {
    far = dae_newton(l->batch->constants, &time, from, l->held, l->parameters, found, &left);
    near = NOT_MORE(left, REACHED) & open & ~far;
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

/* Writes the next row of the record of some runs. */
static void write(Lanes *l, mask wanted, real time, const real *x) {
  const Batch *b = l->batch;
  real values[WIDTH + 1];
  mask good;
  int i, lane;
  wanted &= l->alive;
  if (!any(wanted)) return;
  good = ~dae_row(b->constants, &time, x, l->held, l->parameters, values);
  good &= are_numbers(values, WIDTH);
  for (lane = 0; lane < LANES; lane++) {
    double *into;
    if (!AT(wanted, lane) || !AT(good, lane)) continue;
    into = b->rows + (l->number[lane] * b->num_rows + l->run[lane].row++) * WIDTH;
    for (i = 0; i < WIDTH; i++) into[i] = AT(values[i], lane);
  }
  fail(l, wanted & ~good, INVALID);
}

/* Makes the updates of one kind that are due, all at once. */
static void apply(Lanes *l, mask now, int unrestricted) {
  real fresh[HELD + 1], noise[NOISE + 1];
  const Batch *b = l->batch;
  mask good = now;
  int i, lane, number;
  if (!RATES || !any(now)) return;
  memset(noise, 0, sizeof(noise));
  for (lane = 0; lane < LANES; lane++) {
    for (i = 0; i < NOISE && AT(now, lane); i++) {
      AT(noise[i], lane) = b->noise[l->number[lane] * b->noise_step + l->run[lane].event * NOISE + i];
    }
  }
  memcpy(fresh, l->held, sizeof(fresh));
  for (number = 0; number < RATES; number++) {
    real values[HELD + 1];
    mask own = now, valid;
    if (is_unrestricted[number] != unrestricted) continue;
    for (lane = 0; lane < LANES; lane++) {
      if (AT(now, lane)) AT(own, lane) = -(b->due[l->run[lane].event] >> number & 1);
    }
    if (!any(own)) continue;
    valid = ~update_rate(number, b->constants, &l->time, l->x, l->held, l->parameters, noise, values);
    valid &= are_numbers(values, counts[number]);
    good &= valid | ~own;
    for (i = 0; i < counts[number]; i++) {
      fresh[places[number][i]] = CHOOSE(own, values[i], fresh[places[number][i]]);
    }
  }
  memcpy(l->held, fresh, sizeof(fresh));
  fail(l, now & ~good, INVALID);
}

static int is_sampled(const Batch *b, const Run *run) {
  return run->event < b->num_events && b->events[run->event] <= run->time;
}

/* At the start of a step: unrestricted updates, the projection, discrete updates. */
static void update(Lanes *l, mask wanted) {
  for (;;) {
    mask now = none(), open = wanted & l->alive, on;
    int lane;
    for (lane = 0; lane < LANES; lane++) {
      if (!AT(open, lane)) continue;
      if (is_sampled(l->batch, &l->run[lane])) AT(now, lane) = -1;
      if (l->run[lane].on) AT(open, lane) = 0;
    }
    apply(l, now, 1);
    open &= l->alive;
    on = project(l, l->time, l->x, open);
    fail(l, open & ~on, OFF_MANIFOLD);
    now &= l->alive;
    apply(l, now, 0);
    now &= l->alive;
    for (lane = 0; lane < LANES; lane++) {
      if (AT(on, lane)) l->run[lane].on = 1;
      if (AT(now, lane)) l->run[lane].event++;
    }
    if (PROJECTS) l->known &= ~on;
    l->known &= ~now;
    if (!any(now)) return;
    wanted = now;
  }
}

/* reached = x + step * weighted sum of rates; most weights of a high order are zero. */
static void weigh(real step, int count, const double *b, const real *x, real (*k)[SIZE], real *reached) {
  real sum[SIZE];
  int i, j;
  for (i = 0; i < SIZE; i++) sum[i] = K(b[0]) * k[0][i];
  for (j = 1; j < count; j++) {
    const real weight = K(b[j]);
    if (b[j] == 0.0) continue;
    for (i = 0; i < SIZE; i++) sum[i] += weight * k[j][i];
  }
  for (i = 0; i < SIZE; i++) reached[i] = x[i] + step * sum[i];
}

static real weighted(const real *vector, const real *unit) {
  real sum = K(0.0);
  int i;
  for (i = 0; i < SIZE; i++) sum += vector[i] / unit[i] * (vector[i] / unit[i]);
  return square_root(sum / K((double)SIZE));
}

IN_LINE real eighth_root(real x) { return square_root(square_root(square_root(x))); }

/* A first step, as SciPy finds it (Hairer, Norsett and Wanner, section II.4). */
static real first_step(Lanes *l) {
  const Batch *b = l->batch;
  real unit[SIZE], other[SIZE], change[SIZE], d0, d1, d2, h0, h1, longest = K(b->longest);
  const real *rate = l->k[0];
  mask small, valid;
  int i;
  for (i = 0; i < SIZE; i++) unit[i] = K(b->absolute[i]) + magnitude(l->x[i]) * K(b->relative);
  d0 = weighted(l->x, unit), d1 = weighted(rate, unit);
  small = LESS(d0, K(1e-5)) | LESS(d1, K(1e-5));
  h0 = least(CHOOSE(small, K(1e-6), K(0.01) * d0 / d1), longest);
  for (i = 0; i < SIZE; i++) other[i] = l->x[i] + h0 * rate[i];
  valid = rates(l, l->time + h0, other, change);
  for (i = 0; i < SIZE; i++) change[i] -= rate[i];
  d2 = weighted(change, unit) / h0;
  small = NOT_MORE(d1, K(1e-15)) & NOT_MORE(d2, K(1e-15));
  h1 = CHOOSE(small, most(K(1e-6), h0 * K(1e-3)), eighth_root(K(0.01) / most(d1, d2)));
  return least(CHOOSE(valid, least(K(100.0) * h0, h1), h0), longest);
}

/* The error of a step of DOP853 in units of what is allowed. */
static real error_of(const Lanes *l, const real *reached) {
  const Batch *b = l->batch;
  real fifth = K(0.0), third = K(0.0), both;
  int i, j;
  for (i = 0; i < SIZE; i++) {
    real e5 = K(0.0), e3 = K(0.0);
    const real larger = most(magnitude(l->x[i]), magnitude(reached[i]));
    const real unit = K(1.0) / (K(b->absolute[i]) + larger * K(b->relative));
    for (j = 0; j < 12; j++) {
      e5 += K(b->e5[j]) * l->k[j][i];
      e3 += K(b->e3[j]) * l->k[j][i];
    }
    fifth += e5 * unit * (e5 * unit);
    third += e3 * unit * (e3 * unit);
  }
  both = fifth + K(0.01) * third;
  return CHOOSE(SAME(both, K(0.0)), both, l->size * fifth / square_root(both * K((double)SIZE)));
}

/* Which runs have a row within the step. */
static mask with_row(const Lanes *l, mask wanted) {
  int lane;
  for (lane = 0; lane < LANES; lane++) {
    const long long row = l->run[lane].row;
    if (row >= l->batch->num_rows || l->batch->times[row] >= AT(l->end, lane)) AT(wanted, lane) = 0;
  }
  return wanted & l->alive;
}

/* Writes the rows within a step of DOP853, by the interpolant as SciPy has it, on N*. */
static void write_between(Lanes *l, mask wanted, const real *reached) {
  const Batch *b = l->batch;
  real f[7][SIZE], at[SIZE];
  int i, j, s, lane;
  if (!any(wanted = with_row(l, wanted))) return;
  for (s = 13; s < 16; s++) {
    weigh(l->size, s, b->a_more + 16 * (s - 13), l->x, l->k, at);
    rates(l, l->time + K(b->c_more[s - 13]) * l->size, at, l->k[s]);
  }
  for (i = 0; i < SIZE; i++) {
    f[0][i] = reached[i] - l->x[i];
    f[1][i] = l->size * l->k[0][i] - f[0][i];
    f[2][i] = K(2.0) * f[0][i] - l->size * (l->k[12][i] + l->k[0][i]);
    for (j = 0; j < 4; j++) {
      real sum = K(0.0);
      for (s = 0; s < 16; s++) sum += K(b->d[16 * j + s]) * l->k[s][i];
      f[3 + j][i] = l->size * sum;
    }
  }
  for (; any(wanted); wanted = with_row(l, wanted)) {
    real moment = l->time, part;
    for (lane = 0; lane < LANES; lane++) {
      if (AT(wanted, lane)) AT(moment, lane) = b->times[l->run[lane].row];
    }
    part = (moment - l->time) / l->size;
    for (i = 0; i < SIZE; i++) {
      at[i] = K(0.0);
      for (j = 6; j >= 0; j--) at[i] = (at[i] + f[j][i]) * (j % 2 ? K(1.0) - part : part);
      at[i] += l->x[i];
    }
    project(l, moment, at, wanted);
    write(l, wanted, moment, at);
  }
}

/* The end of the next fixed step; their number divides the time between two rows or samples. */
static double fixed_end(const Batch *b, Run *run) {
  double end = b->times[run->row];
  if (run->event < b->num_events && b->events[run->event] < end) end = b->events[run->event];
  if (run->index == run->number) {
    run->from = run->time;
    run->index = 0;
    run->number = (long long)fmax(1.0, ceil((end - run->from) / b->longest - 0.01));
  }
  run->index++;
  if (run->index == run->number) return end;
  return run->from + (end - run->from) * ((double)run->index / (double)run->number);
}

/* Begins a step of some runs: rows and updates of its time, the first rate, its length. */
static void begin(Lanes *l) {
  const Batch *b = l->batch;
  mask row = none(), last = none(), off = none(), begins = l->begins, first = none(), fresh, good;
  real rate[SIZE], step;
  int i, lane;
  for (i = 0; i < SIZE; i++) l->x_before[i] = CHOOSE(begins, l->x[i], l->x_before[i]);
  for (i = 0; i < HELD; i++) l->held_before[i] = CHOOSE(begins, l->held[i], l->held_before[i]);
  for (lane = 0; lane < LANES; lane++) {
    Run *run = &l->run[lane];
    if (!AT(begins, lane)) continue;
    l->before[lane] = *run;
    AT(l->time, lane) = AT(l->end, lane) = run->time;
    if (run->time < b->times[run->row]) continue;
    AT(row, lane) = -1;
    if (run->row == b->num_rows - 1) {
      AT(last, lane) = -1;
    } else if (!b->stages && PROJECTS && !run->on && run->steps) {
      AT(off, lane) = -1; /* A row of error control is on N*. */
    }
  }
  fail(l, off, OFF_MANIFOLD);
  update(l, last); /* The last row comes after the updates of its time. */
  write(l, row, l->time, l->x);
  for (lane = 0; lane < LANES; lane++) {
    if (AT(last, lane) && AT(l->alive, lane)) save(l, lane, DONE, 0);
  }
  update(l, begins & l->alive);
  begins &= l->alive;
  if (!any(begins)) return;
  fresh = begins & ~l->known;
  for (i = 0; i < SIZE; i++) l->k[0][i] = CHOOSE(begins & l->known, l->k[12][i], l->k[0][i]);
  if (any(fresh)) {
    good = rates(l, l->time, l->x, rate);
    for (i = 0; i < SIZE; i++) l->k[0][i] = CHOOSE(fresh, rate[i], l->k[0][i]);
    fail(l, fresh & ~good, INVALID);
  }
  for (lane = 0; lane < LANES; lane++) {
    Run *run = &l->run[lane];
    if (!AT(begins, lane) || !AT(l->alive, lane)) continue;
    l->trials[lane] = l->rejected[lane] = 0;
    if (b->stages) {
      AT(l->limit, lane) = fixed_end(b, run);
      AT(l->size, lane) = AT(l->limit, lane) - run->time;
      continue;
    }
    AT(l->limit, lane) = b->times[b->num_rows - 1];
    if (run->event < b->num_events && b->events[run->event] < AT(l->limit, lane)) {
      AT(l->limit, lane) = b->events[run->event];
    }
    if (run->step == 0.0) AT(first, lane) = -1;
  }
  if (any(first)) step = first_step(l);
  for (lane = 0; lane < LANES && !b->stages; lane++) {
    Run *run = &l->run[lane];
    if (!AT(begins, lane)) continue;
    if (AT(first, lane)) run->step = AT(step, lane);
    AT(l->size, lane) = fmin(run->step, b->longest);
  }
}

/* The end of a trial step. */
static void set_end(Lanes *l) {
  mask stuck = none();
  int lane;
  for (lane = 0; lane < LANES; lane++) {
    const double time = AT(l->time, lane), limit = AT(l->limit, lane);
    double end = time + AT(l->size, lane);
    if (!AT(l->alive, lane)) continue;
    if (l->batch->stages || end >= limit - 1e-12 * fabs(limit)) end = limit;
    AT(l->end, lane) = end;
    AT(l->size, lane) = end - time;
    if (l->batch->stages) continue;
    if (!(end - time > 1e-12 * fabs(time)) || l->trials[lane]++ >= TRIALS) AT(stuck, lane) = -1;
  }
  fail(l, stuck, STUCK);
}

/* Accepts a step of a run, or shortens it. */
static void decide(Lanes *l, int lane, int is_accepted, int is_on, double factor) {
  Run *run = &l->run[lane];
  const double size = AT(l->size, lane), end = AT(l->end, lane);
  if (!is_accepted) {
    l->rejected[lane] = 1;
    AT(l->size, lane) = size * factor;
    return;
  }
  /* A step that only ended early, at a sample, says nothing against longer ones. */
  run->step = l->rejected[lane] ? size * fmin(1.0, factor)
                                : fmax(size * factor, size < run->step ? run->step : 0.0);
  run->time = end;
  run->on = is_on;
  AT(l->begins, lane) = -1;
  if (++run->steps % 1000) return;
  if (end - run->mark < 1e-8 * (end - run->start)) save(l, lane, SLOW, 0);
  run->mark = end;
}

/* One trial of all runs. */
static void step(Lanes *l) {
  const Batch *b = l->batch;
  const int stages = b->stages ? (int)b->stages : 12;
  real reached[SIZE], factor = K(1.0);
  mask accepted, on = none();
  int i, s, lane;
  set_end(l);
  for (s = 1; s < stages; s++) {
    const real time = l->time + K(b->c[s]) * l->size;
    weigh(l->size, s, b->a + s * stages, l->x, l->k, reached);
    rates(l, time, reached, l->k[s]);
  }
  weigh(l->size, stages, b->b, l->x, l->k, reached);
  if (b->stages) {
    fail(l, ~are_numbers(reached, SIZE), SPOILT);
    accepted = l->alive;
  } else {
    const real error = error_of(l, reached);
    mask valid = is_number(error);
    factor = most(K(0.2), K(0.9) / eighth_root(error));
    factor = CHOOSE(SAME(error, K(0.0)), K(10.0), least(K(10.0), factor));
    accepted = l->alive & valid & LESS(error, K(1.0));
    if (any(accepted)) {
      on = project(l, l->end, reached, accepted);
      if (LANES > 1) fail(l, accepted & ~on, OFF_MANIFOLD);
      valid &= rates(l, l->end, reached, l->k[12]) | ~accepted;
      accepted &= valid & l->alive;
      write_between(l, accepted, reached);
      accepted &= l->alive;
    }
    factor = CHOOSE(valid, factor, K(0.2));
  }
  l->begins = none();
  for (i = 0; i < SIZE; i++) l->x[i] = CHOOSE(accepted, reached[i], l->x[i]);
  l->known = CHOOSE_MASK(accepted, on, l->known);
  for (lane = 0; lane < LANES; lane++) {
    if (!AT(l->alive, lane)) continue;
    decide(l, lane, AT(accepted, lane) != 0, AT(on, lane) != 0, AT(factor, lane));
  }
}

/* Makes runs until there are no more to take, or the budget is spent; any number of threads. */
EXPORTED void make_runs(const Batch *b) {
  Lanes l;
  long long left = b->budget;
  int lane;
  memset(&l, 0, sizeof(l));
  l.batch = b;
  for (lane = 0; lane < LANES; lane++) load(b, &l, lane, 0); /* Numbers for those without a run. */
  for (;;) {
    for (lane = 0; lane < LANES; lane++) {
      long long number;
      if (AT(l.alive, lane)) continue;
      number = __atomic_fetch_add(b->next, 1, __ATOMIC_RELAXED);
      if (number >= b->num_runs) continue;
      load(b, &l, lane, number);
      AT(l.alive, lane) = AT(l.begins, lane) = -1;
    }
    if (!any(l.alive) || *b->next >= STOPPED) return;
    l.begins &= l.alive;
    if (any(l.begins)) {
      if (LANES == 1 && left-- == 0) {
        save(&l, 0, PAUSED, 0);
        return;
      }
      begin(&l);
    }
    if (any(l.alive)) step(&l);
  }
}
