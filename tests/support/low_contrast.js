// Texts of a page whose contrast to what is behind them is below WCAG's AA: 4.5, or 3 for large ones.
const numbers = (color) => { const found = color.match(/[\d.]+/g).map(Number); return found.length < 4 ? [...found, 1] : found; };
const linear = (v) => v <= 10.31 ? v / 3294.6 : ((v / 255 + 0.055) / 1.055) ** 2.4;
const light = (color) => 0.05 + [0.2126, 0.7152, 0.0722].reduce((sum, w, i) => sum + w * linear(color[i]), 0);
const over = (top, below) => [0, 1, 2].map((i) => top[i] * top[3] + below[i] * (1 - top[3])).concat(1);
const dark = matchMedia("(prefers-color-scheme: dark)").matches
  && getComputedStyle(document.documentElement).colorScheme.includes("dark");
function behind(element) {
  const layers = [];
  for (let one = element; one; one = one.parentElement) layers.push(numbers(getComputedStyle(one).backgroundColor));
  return layers.reverse().reduce((below, top) => over(top, below), dark ? [18, 18, 18, 1] : [255, 255, 255, 1]);
}
const low = {}, walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const element = walker.currentNode.parentElement, style = getComputedStyle(element);
  const isShown = walker.currentNode.textContent.trim() && element.getClientRects().length
    && style.visibility !== "hidden" && !element.closest("script, style, noscript, #told");
  if (!isShown) continue;
  const back = behind(element), text = over(numbers(style.color), back), size = parseFloat(style.fontSize);
  const [most, least] = [light(text), light(back)].sort((a, b) => b - a);
  const isLarge = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
  if (most / least < (isLarge ? 3 : 4.5)) low[walker.currentNode.textContent.trim().slice(0, 40)] = most / least;
}
return JSON.stringify([walker.root.textContent.length > 100, low]);
