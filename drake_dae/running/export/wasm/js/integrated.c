typedef ${prefix}_$kind Own_$kind;

SHOWN("${kind}_create") Own_$kind *${kind}_create(void) {
  Own_$kind *own = (Own_$kind *)take(sizeof(Own_$kind));
  if (own) ${prefix}_${kind}_init(own);
  return own;
}
SHOWN("${kind}_reset") void ${kind}_reset(Own_$kind *own) { ${prefix}_${kind}_init(own); }
SHOWN("${kind}_advance") int ${kind}_advance(Own_$kind *own, double time) {
  return ${prefix}_${kind}_advance(own, time);
}
SHOWN("${kind}_show") int ${kind}_show(Own_$kind *own) { return ${prefix}_${kind}_show(own); }
SHOWN("${kind}_time") double ${kind}_time(const Own_$kind *own) { return own->time; }
SHOWN("${kind}_longest") double *${kind}_longest(Own_$kind *own) { return &own->longest; }
SHOWN("${kind}_parameters") double *${kind}_parameters(Own_$kind *own) { return own->parameters; }
SHOWN("${kind}_inputs") double *${kind}_inputs(Own_$kind *own) {
  return own->parameters + ${guard}_${KIND}_PARAMETERS;
}
SHOWN("${kind}_state") double *${kind}_state(Own_$kind *own) { return own->state; }
SHOWN("${kind}_outputs") double *${kind}_outputs(Own_$kind *own) { return own->row; }

