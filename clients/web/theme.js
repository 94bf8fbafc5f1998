// Applies the chosen theme before the first paint. Without a choice, the system's preference holds (app.css).
try {
  const theme = localStorage.getItem('qedgix-theme');
  if (theme === 'light' || theme === 'dark') document.documentElement.dataset.theme = theme;
} catch {
  // Storage is not available: the system's preference holds.
}
