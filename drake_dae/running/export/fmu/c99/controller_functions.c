static void reset(Own *own) {
  memset(own, 0, sizeof(*own));
  ${prefix}_controller_init(&own->controller);
}

/* Before the first step there is the control of a stop. */
static void refresh(Instance *instance) {
  Own *own = &instance->data.own;
  memcpy(own->out.control, own->controller.stop_control, sizeof(own->out.control));
  own->out.status = ${guard}_WAITING;
}

static Status begin(Instance *instance) {
  refresh(instance);
  instance->data.own.origin = instance->data.time;
  return OK;
}

/* All ticks from a time on, before another; inputs are held meanwhile. */
static Status step(Instance *instance, double to) {
  static const double PERIOD = ${guard}_CONTROLLER_PERIOD;
  Own *own = &instance->data.own;
  for (;;) {
    double time = own->origin + (double)own->tick * PERIOD;
    if (!(time < to - 1e-6 * PERIOD)) return OK;
    own->in.time = time;
    own->in.measured_at = time - own->age;
    ${prefix}_controller_step(&own->controller, &own->in, &own->out);
    own->tick++;
  }
}
