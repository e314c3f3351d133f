/* The first of some runs. */
static int first_of(mask some) {
  int lane = 0;
  while (lane < LANES - 1 && !some[lane]) lane++;
  return lane;
}

/* Fixed steps of LANES runs, all at the same times. */
static void run_together(const Batch *b, long long first) {
  Lanes l;
  Run run[LANES], before; /* equal for all active runs: that of the first */
  real k[16][SIZE], reached[SIZE], x[SIZE], held[HELD + 1];
  long long rows[LANES];
  mask alive = none(), changed;
  int i, s, lane;
  for (lane = 0; lane < LANES; lane++) {
    long long own = first + lane;
    if (own < b->num_runs) alive[lane] = -1;
    load(b, &l, lane, own < b->num_runs ? own : b->num_runs - 1);
    run[lane] = begun(b);
  }
  for (;;) {
    mask good = alive;
    int is_row, is_last;
    double end, step;
    real time;
    before = run[0];
    time = K(before.time);
    is_row = before.time >= b->times[before.row];
    is_last = is_row && before.row == b->num_rows - 1;
    memcpy(x, l.x, sizeof(x));
    memcpy(held, l.held, sizeof(held));
    if (is_row) {
      if (is_last) {
        good &= updates(b, time, &l, good, good, run, &changed);
        run[0].event = run[first_of(good)].event;
      }
      for (lane = 0; lane < LANES; lane++) rows[lane] = before.row;
      good &= write(b, &l, good, time, l.x, rows);
      run[0].row++;
    }
    if (!is_last) {
      good &= updates(b, time, &l, good, good, run, &changed);
      run[0].event = run[first_of(good)].event;
      end = b->times[run[0].row];
      if (run[0].event < b->num_events && b->events[run[0].event] < end) end = b->events[run[0].event];
      if (run[0].index == run[0].number) {
        run[0].from = before.time;
        run[0].index = 0;
        run[0].number = (long long)fmax(1.0, ceil((end - before.time) / b->longest - 0.01));
      }
      run[0].index++;
      if (run[0].index < run[0].number) {
        end = run[0].from + (end - run[0].from) * ((double)run[0].index / (double)run[0].number);
      }
      step = end - before.time;
      good &= rates(time, l.x, &l, k[0]);
      for (s = 1; s < b->stages; s++) {
        weigh(K(step), s, b->a + s * b->stages, l.x, k, reached);
        good &= rates(K(before.time + b->c[s] * step), reached, &l, k[s]);
      }
      weigh(K(step), (int)b->stages, b->b, l.x, k, reached);
      for (i = 0; i < SIZE; i++) good &= is_number(reached[i]);
      run[0].time = end;
      if (++run[0].steps % 1000 == 0) {
        run[0].before = run[0].mark;
        run[0].mark = end;
        if (end - run[0].before < 1e-8 * (end - run[0].start)) good = none();
      }
    }
    if (IS_STOPPED(b)) return;
    if (any(alive & ~good)) {
      for (lane = 0; lane < LANES; lane++) {
        if (alive[lane] && !good[lane]) save(b, &l, lane, x, held, before, HANDED_OVER);
      }
      alive &= good;
      if (!any(alive)) return;
    }
    if (is_last) break;
    memcpy(l.x, reached, sizeof(reached));
    for (lane = 1; RATES && lane < LANES; lane++) run[lane] = run[0];
  }
  for (lane = 0; lane < LANES; lane++) {
    if (alive[lane]) save(b, &l, lane, l.x, l.held, run[0], DONE);
  }
}
