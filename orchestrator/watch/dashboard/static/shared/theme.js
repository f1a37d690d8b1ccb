// Light, dark, or the theme of the system. A classic script in the head, so that no page flashes in the wrong one.
(() => {
  const KEY = "panolog-theme";
  const root = document.documentElement;
  const stored = () => {
    try {
      return localStorage.getItem(KEY);
    } catch {
      return null;
    } // storage may be forbidden
  };
  const isDark = () =>
    (root.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  /** @param {string | null | undefined} theme */
  const apply = (theme) => {
    if (theme === "light" || theme === "dark") root.dataset.theme = theme;
    document.dispatchEvent(new Event("themechange"));
  };
  apply(stored());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => apply(root.dataset.theme));
  document.addEventListener("DOMContentLoaded", () => {
    const button = document.getElementById("theme");
    const label = () => button?.setAttribute("aria-label", isDark() ? "Switch to light" : "Switch to dark");
    button?.addEventListener("click", () => {
      const theme = isDark() ? "light" : "dark";
      try {
        localStorage.setItem(KEY, theme);
      } catch {
        /* it lasts as long as the page */
      }
      apply(theme);
    });
    document.addEventListener("themechange", label);
    label();
  });
})();
