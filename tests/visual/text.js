// Every text that can be seen, as [text, boxes, ink, contrast that it needs, class, element]: boxes [x, y, width, height] in pixels
// of the page, ink [red, green, blue, alpha]. Also what placeholders, fields and pseudo-elements say. Under a modal
// dialog only the dialog counts. With `hide`, texts become transparent afterwards, and their background can be looked at.
(hide) => {
  const pen = Object.assign(document.createElement("canvas"), {width: 1, height: 1}).getContext("2d", {willReadFrequently: true});
  const parsed = new Map();
  const parse = (color) => {
    if (!parsed.has(color)) {
      pen.clearRect(0, 0, 1, 1);
      pen.fillStyle = color;
      pen.fillRect(0, 0, 1, 1);
      const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data;
      parsed.set(color, [r, g, b, a / 255]);
    }
    return parsed.get(color);
  };
  const opacity = (node) => (node ? Number(getComputedStyle(node).opacity) * opacity(node.parentElement) : 1);
  const clips = (node) => {
    const found = [];
    for (let at = node; at && at !== document.body; at = at.parentElement) {
      const {overflow, position} = getComputedStyle(at);
      if (overflow !== "visible") found.push(at.getBoundingClientRect());
      if (position === "fixed") found.push({left: 0, top: 0, right: innerWidth, bottom: innerHeight});
    }
    return found;
  };
  const seen = (rects, node) => {
    const around = clips(node);
    return [...rects].flatMap((rect) => {
      let {left, top, right, bottom} = rect;
      for (const clip of around) {
        [left, top] = [Math.max(left, clip.left), Math.max(top, clip.top)];
        [right, bottom] = [Math.min(right, clip.right), Math.min(bottom, clip.bottom)];
      }
      const most = bottom - top > 0.6 * (rect.bottom - rect.top); // of a line that is cut off, less says nothing
      return right - left > 2 && bottom - top > 2 && most ? [[left + scrollX, top + scrollY, right - left, bottom - top]] : [];
    });
  };
  const texts = [];
  const elements = new Map();
  const number = (node) => elements.get(node) ?? elements.set(node, elements.size).get(node);
  const add = (text, node, rects, style, color, element = number(node.closest("text") ?? node)) => {
    const boxes = seen(rects, node);
    if (!/[\p{L}\p{N}\p{P}\p{S}]/u.test(text) || !boxes.length) return;
    const size = parseFloat(style.fontSize);
    const needed = size >= 24 || (size >= 18.66 && style.fontWeight >= 700) ? 3 : 4.5;
    const [r, g, b, a] = parse(color);
    const fill = node.closest("svg") ? Number(style.fillOpacity) : 1;
    texts.push([text.trim().slice(0, 60), boxes, [r, g, b, a * fill * opacity(node)], needed, String(node.className?.baseVal ?? node.className), element]);
  };
  const visible = (node) => node.checkVisibility({opacityProperty: true, visibilityProperty: true});
  const root = document.querySelector("dialog:modal") ?? document.body;
  const walker = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement;
    if (!visible(node) || node.closest("option, script, style, title, defs")) continue;
    const style = getComputedStyle(node), drawn = node.closest("svg");
    const range = document.createRange();
    range.selectNodeContents(walker.currentNode);
    const rects = drawn ? [node.getBoundingClientRect()] : range.getClientRects();
    add(walker.currentNode.data, node, rects, style, drawn ? style.fill : style.webkitTextFillColor);
  }
  for (const node of root.querySelectorAll("*")) {
    if (!visible(node)) continue;
    for (const part of ["::before", "::after"]) {
      const style = getComputedStyle(node, part);
      if (/^".*[\p{L}\p{N}].*"$/u.test(style.content)) add(style.content.slice(1, -1), node, [node.getBoundingClientRect()], style, style.color, -1);
    }
    const inside = () => {
      const box = node.getBoundingClientRect(), style = getComputedStyle(node);
      const [left, right] = [box.left + parseFloat(style.paddingLeft), box.right - parseFloat(style.paddingRight)];
      return [{left, right, top: box.top + box.height / 4, bottom: box.bottom - box.height / 4}];
    };
    if (node.matches("select")) add(node.selectedOptions[0]?.text ?? "", node, inside(), getComputedStyle(node), getComputedStyle(node).color);
    if (node.matches("input, textarea") && !node.matches("[type=range], [type=checkbox], [type=radio]")) {
      const style = getComputedStyle(node, node.value ? null : "::placeholder");
      const [r, g, b, a] = parse(style.color);
      add(node.value || node.placeholder, node, inside(), style, `rgb(${r} ${g} ${b} / ${a * Number(node.value ? 1 : style.opacity)})`);
    }
  }
  if (hide) {
    const sheet = new CSSStyleSheet(); // not an inline style, which the policy of a page may refuse
    const clear = "-webkit-text-fill-color: transparent !important; text-decoration-color: transparent !important; text-shadow: none !important;";
    sheet.replaceSync(`*, *::before, *::after, ::placeholder { ${clear} } svg text, svg tspan { fill: transparent !important; stroke: none !important; }`);
    document.adoptedStyleSheets = [...document.adoptedStyleSheets, sheet];
    return [texts, document.adoptedStyleSheets.length];
  }
  return [texts, 0];
}
