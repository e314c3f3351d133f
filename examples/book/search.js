// Sphinx's search finds pages with all words of a question. Here a page is the better the more words it has:
// rare words count more than common ones, and long pages, which have many words, less than short ones.
const byWords = () => {
  const withAll = Search.performTermsSearch;
  Search.performTermsSearch = (words, excluded) => {
    const { docnames, terms, titles } = Search._index;
    const lengths = docnames.map(() => 0), found = new Map();
    for (const pages of Object.values(terms)) for (const page of [pages].flat()) lengths[page] += 1;
    const mean = lengths.reduce((sum, length) => sum + length) / lengths.length;
    for (const word of words) {
      const pages = withAll(new Set([word]), excluded);
      const rarity = Math.log(docnames.length / Math.max(pages.length, 1));
      for (const page of pages) {
        const sum = found.get(page[0]) ?? page.with(4, 0);
        const length = lengths[docnames.indexOf(page[0])] / mean;
        sum[4] += (rarity * page[4]) / (0.5 + 0.5 * length);
        found.set(page[0], sum);
      }
    }
    // A page whose title has the question as it was written comes first: Sphinx drops words as "own" and "my".
    const asked = (new URLSearchParams(location.search).get("q") ?? "").trim().toLowerCase();
    docnames.forEach((name, i) => {
      const place = titles[i].toLowerCase().indexOf(asked);
      if (found.has(name) && place >= 0) found.get(name)[4] += place ? 50 : 100;
    });
    return [...found.values()];
  };
};

// Before version 9 Sphinx loads its search after this file.
if (typeof Search === "undefined") document.addEventListener("DOMContentLoaded", byWords);
else byWords();

// Pages that answer a question come first; the name of an object leads to it.
var Scorer = {
  score: ([docname, , , , score]) => {
    return docname.startsWith("how_to/") ? score * 1.5 : score;
  },
  objNameMatch: 99,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
