/* A function of all outputs and parameters of a part, which a page needs beside it. */

$generated
double *$symbol(const double *row, const double *parameters) {
  static double found[$size + 1];
  const double *arg[$given + 2] = {row, parameters};
  double *res[$results + 1] = {found};
  ${symbol}_traced(arg, res, 0, 0, 0);
  return found;
}
