/* The predicted error: e' = E e (30), from where it was started last. */
class Prediction {
  constructor(told, value) {
    this.told = told; /* size, ends, gains, shown */
    this.value = value; /* input -> its present value */
    this.steps = new Map();
  }
  restart({ time, coordinates }) {
    const { size, ends, gains } = this.told;
    this.E = Array.from({ length: size }, (_, i) =>
      Array.from({ length: size }, (_, j) => (j === i + 1 && !ends.includes(i) ? 1 : 0)));
    for (const [row, column, input] of gains) this.E[row][column] = -this.value(input);
    this.steps.clear();
    this.time = time;
    this.coordinates = coordinates;
  }
  /* The error of each output at a later time. */
  at(time) {
    const { shown } = this.told;
    const length = time - this.time;
    const key = length.toFixed(12);
    if (!this.steps.has(key)) this.steps.set(key, exponential(this.E.map((row) => row.map((x) => x * length))));
    if (length) this.coordinates = times(this.steps.get(key), this.coordinates);
    this.time = time;
    const rates = times(this.E, this.coordinates);
    const errors = data.outputs.map(() => 0);
    for (const [i, place, isRate] of shown) errors[i] = isRate ? rates[place] : this.coordinates[place];
    return errors;
  }
}

const times = (matrix, column) => matrix.map((row) => row.reduce((sum, x, j) => sum + x * column[j], 0));
const product = (a, b) => a.map((row) => b[0].map((_, j) => row.reduce((sum, x, k) => sum + x * b[k][j], 0)));

/* exp(A): Taylor's series of A / 2^k, squared k times. */
function exponential(A) {
  const norm = Math.max(0, ...A.map((row) => row.reduce((sum, x) => sum + Math.abs(x), 0)));
  const halvings = norm > 0.25 ? Math.ceil(Math.log2(norm)) + 2 : 0;
  const small = A.map((row) => row.map((x) => x / 2 ** halvings));
  const identity = A.map((row, i) => row.map((_, j) => (i === j ? 1 : 0)));
  let found = identity;
  for (let n = 14; n > 0; n--) {
    found = product(small, found).map((row, i) => row.map((x, j) => x / n + identity[i][j]));
  }
  for (let k = 0; k < halvings; k++) found = product(found, found);
  return found;
}
