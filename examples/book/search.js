// Sphinx's weights, and a preference: pages that answer a question come first, lists of them last.
var Scorer = {
  score: ([docname, , , , score]) => {
    if (docname.startsWith("how_to/index_") || docname === "reference/error_codes") return score - 10;
    return docname.startsWith("how_to/") ? score + 8 : score;
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
