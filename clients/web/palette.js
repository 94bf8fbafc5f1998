// One colour per algorithm, everywhere: the palette of Okabe and Ito, which colour-blind readers can tell apart. In the dark theme, the
// same hues are lighter. Further curves also differ in their dashes.

const LIGHT = ['#0072b2', '#d55e00', '#009e73', '#b87d00', '#b5528c', '#2c93cf', '#444444', '#8a8a8a'];
const DARK = ['#4aa8e8', '#f0803c', '#2cc49a', '#f0b840', '#dd94bd', '#8fd0f5', '#e0e0e0', '#9a9a9a'];

/** The place of an algorithm or baseline in the palette. */
const PLACES = {
  qedgix: 0, qmix: 1, vdn: 2, iql: 3, agggnn: 4, rgcn: 6,
  'greedy-global': 5, tour: 7, sweep: 2, 'sweep-shared': 3, nearest: 4, 'max-aoi': 5, random: 7, persistent: 6,
};

const DASHES = [[], [7, 4], [2, 3], [10, 3, 2, 3]];

/** Whether the page is dark now. */
export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === 'dark' : matchMedia('(prefers-color-scheme: dark)').matches;
}

export const colour = (place) => (isDark() ? DARK : LIGHT)[place % LIGHT.length];

/** The colour of an algorithm, a baseline, or another policy by the algorithm that trained it. */
export const algorithmColour = (name) => colour(PLACES[name] ?? 6);

/**
 * Colours and dashes for curves. Curves of one algorithm have its colour, and differ in dashes; if all have the same algorithm or
 * none, they differ in colour.
 */
export function styles(algorithms) {
  const distinct = new Set(algorithms.map((name) => PLACES[name] ?? -1));
  if (distinct.size <= 1 || distinct.has(-1)) {
    return algorithms.map((_, i) => ({ colour: colour(i), dash: DASHES[Math.floor(i / LIGHT.length) % DASHES.length] }));
  }
  const seen = {};
  return algorithms.map((name) => {
    const nth = (seen[name] = (seen[name] ?? -1) + 1);
    return { colour: algorithmColour(name), dash: DASHES[nth % DASHES.length] };
  });
}

/** A colour with an opacity. */
export function faded(hex, opacity) {
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  return `rgba(${r}, ${g}, ${b}, ${opacity})`;
}
