// Order of search results: pages that say how to do something come before decision records and figures.
var Scorer = {
  score: (result) => {
    const [docname, title, anchor, descr, score, filename, kind] = result;
    if (docname.startsWith("adr/") || docname.startsWith("benchmarks")) return score - 20;
    if (docname.startsWith("method/") || docname === "architecture") return score - 4;
    if (docname.startsWith("guide/") || docname.startsWith("tutorials/")) return score + 2;
    return score;
  },
  // The rest are the values of Sphinx.
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
