typedef struct {
  ${prefix}_controller own;
  ${prefix}_controller_inputs in;
  ${prefix}_controller_outputs out;
} Own_controller;

SHOWN("controller_reset") void controller_reset(Own_controller *own) {
  ${prefix}_controller_init(&own->own);
}
SHOWN("controller_create") Own_controller *controller_create(void) {
  Own_controller *own = (Own_controller *)take(sizeof(Own_controller));
  if (own) controller_reset(own);
  return own;
}
SHOWN("controller_step") int controller_step(Own_controller *own, double time, double measured_at) {
  own->in.time = time;
  own->in.measured_at = measured_at;
  return ${prefix}_controller_step(&own->own, &own->in, &own->out);
}
SHOWN("controller_fault") int controller_fault(const Own_controller *own) { return own->out.fault; }
SHOWN("controller_parameters") double *controller_parameters(Own_controller *own) {
  return own->own.parameters;
}
SHOWN("controller_inputs") double *controller_inputs(Own_controller *own) {
  return &own->in.measured_at + 1;
}
SHOWN("controller_outputs") double *controller_outputs(Own_controller *own) {
  return (double *)&own->out;
}
SHOWN("controller_stop_control") double *controller_stop_control(Own_controller *own) {
  return own->own.stop_control;
}
SHOWN("controller_stop_time") double *controller_stop_time(Own_controller *own) {
  return &own->own.stop_time;
}
SHOWN("controller_max_age") double *controller_max_age(Own_controller *own) {
  return &own->own.max_age;
}
SHOWN("controller_patience") void controller_patience(Own_controller *own, int steps) {
  own->own.patience = steps;
}

