/* Error control by DOP853, each run with its own step; in the order of stepper.c. */

static real weighted(const real *vector, const real *unit) {
  real sum = K(0.0);
  int i;
  for (i = 0; i < SIZE; i++) sum += vector[i] / unit[i] * (vector[i] / unit[i]);
  return square_root(sum / K((double)SIZE));
}

IN_LINE real eighth_root(real x) { return square_root(square_root(square_root(x))); }

/* A first step, as SciPy finds it. */
static real first_step(const Batch *b, real time, const real *rate, Lanes *l) {
  real unit[SIZE], other[SIZE], change[SIZE], d0, d1, d2, h0, h1, longest = K(b->longest);
  mask small, valid;
  int i;
  for (i = 0; i < SIZE; i++) unit[i] = K(b->absolute[i]) + magnitude(l->x[i]) * K(b->relative);
  d0 = weighted(l->x, unit), d1 = weighted(rate, unit);
  small = LESS(d0, K(1e-5)) | LESS(d1, K(1e-5));
  h0 = least(CHOOSE(small, K(1e-6), K(0.01) * d0 / d1), longest);
  for (i = 0; i < SIZE; i++) other[i] = l->x[i] + h0 * rate[i];
  valid = rates(time + h0, other, l, change);
  for (i = 0; i < SIZE; i++) change[i] -= rate[i];
  d2 = weighted(change, unit) / h0;
  small = NOT_MORE(d1, K(1e-15)) & NOT_MORE(d2, K(1e-15));
  h1 = CHOOSE(small, most(K(1e-6), h0 * K(1e-3)), eighth_root(K(0.01) / most(d1, d2)));
  return least(CHOOSE(valid, least(K(100.0) * h0, h1), h0), longest);
}

static real error_of(const Batch *b, real step, const real *x, const real *reached,
                               real (*k)[SIZE]) {
  real fifth = K(0.0), third = K(0.0), both;
  int i, j;
  for (i = 0; i < SIZE; i++) {
    real e5 = K(0.0), e3 = K(0.0);
    const real larger = most(magnitude(x[i]), magnitude(reached[i]));
    const real unit = K(1.0) / (K(b->absolute[i]) + larger * K(b->relative));
    for (j = 0; j < 12; j++) {
      e5 += K(dop_e5[j]) * k[j][i];
      e3 += K(dop_e3[j]) * k[j][i];
    }
    fifth += e5 * unit * (e5 * unit);
    third += e3 * unit * (e3 * unit);
  }
  both = fifth + K(0.01) * third;
  return CHOOSE(SAME(both, K(0.0)), both, step * fifth / square_root(both * K((double)SIZE)));
}

/* The interpolant within a step, as SciPy has it. */
static void interpolant(real size, const real *x, const real *reached, real (*k)[SIZE],
                                  real (*f)[SIZE]) {
  int i, j, s;
  for (i = 0; i < SIZE; i++) {
    f[0][i] = reached[i] - x[i];
    f[1][i] = size * k[0][i] - f[0][i];
    f[2][i] = K(2.0) * f[0][i] - size * (k[12][i] + k[0][i]);
    for (j = 0; j < 4; j++) {
      real sum = K(0.0);
      for (s = 0; s < 16; s++) sum += K(dop_d[j][s]) * k[s][i];
      f[3 + j][i] = size * sum;
    }
  }
}

/* Returns which runs have a row before given times. */
static mask with_row(const Batch *b, mask wanted, const Run *run, real end) {
  int lane;
  for (lane = 0; lane < LANES; lane++) {
    long long row = run[lane].row;
    if (row >= b->num_rows || b->times[row] >= end[lane]) wanted[lane] = 0;
  }
  return wanted;
}

/* Writes the rows within steps; returns for which runs this succeeds. */
static mask write_between(const Batch *b, Lanes *l, mask wanted, real time, real size,
                                    real end, const real *reached, real (*k)[SIZE], Run *run) {
  real f[7][SIZE], at[SIZE];
  long long rows[LANES];
  mask good = wanted;
  int i, j, s, lane;
  if (!any(wanted = with_row(b, wanted, run, end))) return good;
  for (s = 13; s < 16; s++) {
    weigh(size, s, dop_a_more[s - 13], l->x, k, at);
    rates(time + K(dop_c_more[s - 13]) * size, at, l, k[s]);
  }
  interpolant(size, l->x, reached, k, f);
  for (; any(wanted); wanted = with_row(b, wanted & good, run, end)) {
    real moment = time, part;
    for (lane = 0; lane < LANES; lane++) {
      rows[lane] = run[lane].row;
      if (wanted[lane]) moment[lane] = b->times[run[lane].row++];
    }
    part = (moment - time) / size;
    for (i = 0; i < SIZE; i++) {
      at[i] = K(0.0);
      for (j = 6; j >= 0; j--) at[i] = (at[i] + f[j][i]) * (j % 2 ? K(1.0) - part : part);
      at[i] += l->x[i];
    }
    project(moment, at, l, wanted);
    good &= write(b, l, wanted, moment, at, rows) | ~wanted;
  }
  return good;
}

/* Runs side by side, each with its own step. */
typedef struct {
  Lanes l;
  Run run[LANES], before[LANES];
  real k[16][SIZE], x[SIZE], held[HELD + 1]; /* before the step */
  real time, size, limit;
  mask fresh, known; /* run just loaded; rate at the end of the last step is valid */
  int trials[LANES], rejected[LANES];
} Stepping;

/* Begins a step of some runs; returns for which runs this succeeds. */
static mask begin(const Batch *b, Stepping *p, mask begins) {
  real rate[SIZE], first;
  long long rows[LANES];
  mask good = begins, changed, wanted = p->fresh & begins;
  int i, lane;
  for (i = 0; i < SIZE; i++) p->x[i] = CHOOSE(begins, p->l.x[i], p->x[i]);
  for (i = 0; i < HELD; i++) p->held[i] = CHOOSE(begins, p->l.held[i], p->held[i]);
  for (lane = 0; lane < LANES; lane++) {
    rows[lane] = p->run[lane].row;
    if (!begins[lane]) continue;
    p->before[lane] = p->run[lane];
    p->time[lane] = p->run[lane].time;
  }
  if (any(wanted)) {
    good &= write(b, &p->l, wanted, p->time, p->l.x, rows) | ~wanted;
    for (lane = 0; lane < LANES; lane++) p->run[lane].row += wanted[lane] != 0;
  }
  good &= updates(b, p->time, &p->l, good, good & ~p->known, p->run, &changed);
  p->known &= ~changed;
  for (i = 0; i < SIZE; i++) p->k[0][i] = CHOOSE(begins & p->known, p->k[12][i], p->k[0][i]);
  if (any(begins & ~p->known)) {
    good &= rates(p->time, p->l.x, &p->l, rate) | p->known;
    for (i = 0; i < SIZE; i++) p->k[0][i] = CHOOSE(begins & ~p->known, rate[i], p->k[0][i]);
  }
  if (any(wanted)) {
    first = first_step(b, p->time, p->k[0], &p->l);
    for (lane = 0; lane < LANES; lane++) {
      if (wanted[lane]) p->run[lane].step = first[lane];
    }
  }
  for (lane = 0; lane < LANES; lane++) {
    const Run *run = &p->run[lane];
    double limit = b->times[b->num_rows - 1];
    if (!begins[lane]) continue;
    if (run->event < b->num_events && b->events[run->event] < limit) limit = b->events[run->event];
    p->limit[lane] = limit;
    p->size[lane] = fmin(run->step, b->longest);
    p->trials[lane] = p->rejected[lane] = 0;
  }
  p->fresh &= ~begins;
  return good;
}

/* Computes the end of a trial step; returns which steps are long enough. */
static mask bounded(Stepping *p, mask alive, real *end) {
  int lane;
  for (lane = 0; lane < LANES; lane++) {
    double time = p->time[lane], limit = p->limit[lane];
    double stop = time + p->size[lane];
    if (stop >= limit - 1e-12 * fabs(limit)) stop = limit;
    (*end)[lane] = stop;
    p->size[lane] = stop - time;
    if (!(stop - time > 1e-12 * fabs(time)) || p->trials[lane]++ >= TRIALS) alive[lane] = 0;
  }
  return alive;
}

/* Accepts a step of a run, or shortens it; returns 0 if the run adds hardly any time. */
static int decide(Stepping *p, int lane, int accepted, double end, double factor) {
  Run *run = &p->run[lane];
  double size = p->size[lane];
  if (!accepted) {
    p->rejected[lane] = 1;
    p->size[lane] = size * factor;
    return 1;
  }
  /* A step that only ended early, at a sample, says nothing against longer ones. */
  run->step = p->rejected[lane] ? size * fmin(1.0, factor)
                                : fmax(size * factor, size < run->step ? run->step : 0.0);
  run->time = end;
  run->pending = ALL & ~PROJECTION;
  if (++run->steps % 1000 == 0) {
    run->before = run->mark;
    run->mark = end;
    if (end - run->before < 1e-8 * (end - run->start)) return 0;
  }
  return 1;
}

/* Writes the rows at the ends of steps; returns for which runs this succeeds. */
static mask write_ends(const Batch *b, Stepping *p, mask wanted, real end) {
  long long rows[LANES];
  mask at_row = wanted, at_last, changed;
  int lane;
  for (lane = 0; lane < LANES; lane++) {
    rows[lane] = p->run[lane].row;
    if (rows[lane] >= b->num_rows || b->times[rows[lane]] != end[lane]) at_row[lane] = 0;
  }
  if (!any(at_row)) return wanted;
  at_last = at_row;
  for (lane = 0; lane < LANES; lane++) {
    if (rows[lane] < b->num_rows - 1) at_last[lane] = 0;
  }
  if (any(at_last)) wanted &= updates(b, end, &p->l, at_last, none(), p->run, &changed) | ~at_last;
  wanted &= write(b, &p->l, at_row & wanted, end, p->l.x, rows) | ~at_row;
  for (lane = 0; lane < LANES; lane++) p->run[lane].row += at_row[lane] != 0;
  return wanted;
}

/* Runs until there are no more to take. */
static void run_apart(const Batch *b) {
  Stepping p;
  real reached[SIZE], end = K(0.0);
  mask alive = ~none(), begins = none(), finished = ~none();
  int i, s, lane;
  memset(&p, 0, sizeof(p));
  for (;;) {
    mask good, valid, accepted, on;
    real error, factor;
    for (lane = 0; lane < LANES; lane++) {
      long long own;
      if (!finished[lane] || !alive[lane]) continue;
      own = take(b, 1);
      alive[lane] = -(own < b->num_runs);
      load(b, &p.l, lane, own < b->num_runs ? own : b->num_runs - 1);
      p.run[lane] = begun(b);
      p.fresh[lane] = -1;
      p.known[lane] = 0;
      begins[lane] = -1;
    }
    begins &= alive;
    if (!any(alive)) return;
    good = alive;
    if (any(begins)) good &= begin(b, &p, begins) | ~begins;
    good &= bounded(&p, alive, &end);
    valid = good;
    for (s = 1; s < 12; s++) {
      weigh(p.size, s, dop_a[s], p.l.x, p.k, reached);
      valid &= rates(p.time + K(dop_c[s]) * p.size, reached, &p.l, p.k[s]);
    }
    weigh(p.size, 12, dop_b, p.l.x, p.k, reached);
    error = error_of(b, p.size, p.l.x, reached, p.k);
    valid &= is_number(error);
    factor = most(K(0.2), K(0.9) / eighth_root(error));
    factor = CHOOSE(SAME(error, K(0.0)), K(10.0), least(K(10.0), factor));
    accepted = valid & LESS(error, K(1.0));
    on = project(end, reached, &p.l, accepted);
    good &= on | ~accepted;
    valid &= rates(end, reached, &p.l, p.k[12]) | ~accepted;
    accepted &= valid & good;
    factor = CHOOSE(valid, factor, K(0.2));
    good &= write_between(b, &p.l, accepted, p.time, p.size, end, reached, p.k, p.run) | ~accepted;
    accepted &= good;
    for (i = 0; i < SIZE; i++) p.l.x[i] = CHOOSE(accepted, reached[i], p.l.x[i]);
    p.known |= accepted;
    for (lane = 0; lane < LANES; lane++) {
      if (!good[lane]) continue;
      if (!decide(&p, lane, accepted[lane] != 0, end[lane], factor[lane])) {
        good[lane] = 0;
      }
    }
    good &= write_ends(b, &p, accepted & good, end) | ~accepted;
    if (IS_STOPPED(b)) return;
    finished = alive & ~good;
    for (lane = 0; lane < LANES; lane++) {
      if (finished[lane]) {
        save(b, &p.l, lane, p.x, p.held, p.before[lane], HANDED_OVER);
      } else if (alive[lane] && p.run[lane].row == b->num_rows) {
        save(b, &p.l, lane, p.l.x, p.l.held, p.run[lane], DONE);
        finished[lane] = -1;
      }
    }
    begins = accepted & ~finished;
  }
}
