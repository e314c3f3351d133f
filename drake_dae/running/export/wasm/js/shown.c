extern double *$symbol(const double *row, const double *parameters);
SHOWN("${kind}_$key") double *${kind}_$key(Own_$kind *own) {
  return $symbol(own->row, own->parameters);
}
