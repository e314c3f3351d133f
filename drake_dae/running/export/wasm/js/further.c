/* A function of all outputs and parameters of a part, for a page. */

$generated
double *$symbol(const double *row, const double *parameters) {
  static double values[$size + 1];
  const double *arg[$arguments + 2] = {row, parameters};
  double *res[$results + 1] = {values};
  ${symbol}_traced(arg, res, 0, 0, 0);
  return values;
}
