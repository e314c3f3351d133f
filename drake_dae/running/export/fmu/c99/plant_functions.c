static void reset(Own *own) {
  ${prefix}_plant_init(&own->plant);
  memcpy(own->start, own->plant.state, sizeof(double) * ${guard}_PLANT_STATES);
}

static void set_start(Instance *instance, ${prefix}_plant *plant) {
  memcpy(plant->state, instance->data.own.start, sizeof(double) * ${guard}_PLANT_STATES);
  plant->time = instance->data.time;
}

/* The outputs of what has been set so far. */
static void refresh(Instance *instance) {
  ${prefix}_plant *plant = &instance->data.own.plant, trial = *plant;
  set_start(instance, &trial);
  ${prefix}_plant_show(&trial);
  memcpy(plant->row, trial.row, sizeof(plant->row));
}

static Status result(Instance *instance, int status) {
  if (status == ${guard}_PLANT_OK) return OK;
  return failed(instance, status == ${guard}_PLANT_NO_VALUE
                              ? "a function has no value: not finite, or singular"
                              : "no consistent state is near");
}

static Status begin(Instance *instance) {
  set_start(instance, &instance->data.own.plant);
  return result(instance, ${prefix}_plant_show(&instance->data.own.plant));
}

static Status step(Instance *instance, double to) {
  return result(instance, ${prefix}_plant_advance(&instance->data.own.plant, to));
}
