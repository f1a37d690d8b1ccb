// What one must be able to reach with the keyboard, and what has the focus: [name, whether that is seen].
() => {
  const name = (node) => node.id || `${node.tagName} ${node.getAttribute("aria-label") || node.textContent.trim().slice(0, 30)}`;
  const usable = (node) => node.checkVisibility({visibilityProperty: true}) && !node.disabled && node.tabIndex >= 0;
  const style = getComputedStyle(document.activeElement);
  return {
    reachable: [...document.querySelectorAll("a, button, input, select, summary, [tabindex]")].filter(usable).map(name),
    focused: name(document.activeElement),
    seen: style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2,
  };
}
