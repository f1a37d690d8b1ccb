// What makes a page wider than its window, one line each; what a part of the page scrolls or cuts off does not.
() => {
  const root = document.scrollingElement, width = root.clientWidth;
  const contained = (node) => {
    for (let at = node.parentElement; at && at !== document.body; at = at.parentElement) {
      if (getComputedStyle(at).overflowX !== "visible") return true;
    }
    return false;
  };
  const name = (node) => `${node.localName}${node.id && `#${node.id}`} ${String(node.className?.baseVal ?? node.className)}`.trim();
  const wide = [...document.body.querySelectorAll("*")].flatMap((node) => {
    const {left, right, width: own, height} = node.getBoundingClientRect();
    if (!own || !height || right <= 0 || (left >= -1 && right <= width + 1) || !node.checkVisibility() || contained(node)) return [];
    return [`${name(node)} reaches from ${Math.round(left)} to ${Math.round(right)} in a window of ${width} pixels`];
  });
  if (root.scrollWidth > width) wide.push(`the page is ${root.scrollWidth} pixels wide in a window of ${width}`);
  return wide;
}
