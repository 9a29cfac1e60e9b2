// Runs before the first paint, so that a chosen theme does not flash in.
(function () {
  try {
    const theme = localStorage.getItem("stillpath.theme");
    if (theme === "light" || theme === "dark") document.documentElement.dataset.theme = theme;
  } catch {
    // Storage may be blocked; the system's theme is then used.
  }
})();
