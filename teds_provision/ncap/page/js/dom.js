// Elements, icons, lists. Text is set only by textContent: names of nodes and channels are hostile.

const UNSEEN = /[\p{Cc}\p{Cf}\p{Cn}\p{Co}\p{Zl}\p{Zp}]/gu;

/** Text from others, without invisible characters: U+202E reverses text, and a zero-width letter makes two names look
 * alike. */
const seen = (words) => String(words).replace(UNSEEN, "\ufffd");

const SVG = "http://www.w3.org/2000/svg";

/** An element: `h("p", {class: "note"}, "text", child)`. Functions under on… are listeners; null children are left out. */
export function h(tag, props, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(props ?? {})) set(element, name, value);
  put(element, ...children);
  return element;
}

function set(element, name, value) {
  if (value === null || value === undefined || value === false) return;
  if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
  else if (name === "value" || name === "checked" || name === "disabled" || name === "selected") element[name] = value;
  else element.setAttribute(name, value === true ? "" : seen(value));
}

/** Append children: elements, text, arrays of both. */
export function put(element, ...children) {
  for (const child of children.flat(Infinity)) {
    if (child === null || child === undefined || child === false) continue;
    element.append(child instanceof Node ? child : document.createTextNode(seen(child)));
  }
  return element;
}

/** Replace the children of an element. */
export function fill(element, ...children) {
  element.replaceChildren();
  return put(element, ...children);
}

/** Set text only if it has changed, so that the browser does not repaint. */
export function text(element, words) {
  const shown = seen(words);
  if (element.textContent !== shown) element.textContent = shown;
  return element;
}

const PATHS = {
  good: "M3 8.5 6.5 12 13 4.5",
  bad: "M4 4l8 8M12 4l-8 8",
  warn: "M8 2 15 14H1ZM8 6.5v3.5M8 12v.3",
  ask: "M5.5 6a2.5 2.5 0 1 1 3.6 2.2C8.3 8.7 8 9.2 8 10M8 12.5v.3",
  clock: "M8 1.5a6.5 6.5 0 1 0 .01 0ZM8 4.5V8l2.5 1.5",
  nfc: "M4 5v6M7 3.5c1.3 2.800 1.3 6.200 0 9M10 2c2 3.800 2 8.200 0 12",
  can: "M2 5h12M2 11h12M5 5v6M11 5v6",
  ble: "M5 5l6 6-3 3V2l3 3-6 6",
  virtual: "M2 3h12v8H2zM6 14h4M8 11v3",
  battery: "M1.5 5h11v6h-11zM14.5 7v2",
  charge: "M9 1 4 9h4l-1 6 5-8H8Z",
  wave: "M1 9h3l2-6 3 11 2-5h4",
  chip: "M4 4h8v8H4zM6 1v3M10 1v3M6 12v3M10 12v3M1 6h3M1 10h3M12 6h3M12 10h3",
  play: "M4 2.5v11L13 8Z",
  stop: "M4 4h8v8H4z",
  back: "M10 3 5 8l5 5",
  plus: "M8 3v10M3 8h10",
  list: "M5 4h9M5 8h9M5 12h9M2 4h.3M2 8h.3M2 12h.3",
  gauge: "M2 12a6.5 6.5 0 1 1 12 0M8 11l3-4",
};

/** An icon, hidden from screen readers because the text beside it has the same meaning. */
export function icon(name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("class", "icon");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(SVG, "path");
  path.setAttribute("d", PATHS[name] ?? PATHS.ask);
  svg.append(path);
  return svg;
}

/** A word with an icon and a tone (good, warn, bad, plain, busy): never colour alone. */
export function chip(tone, sign, words, title) {
  return h("span", { class: `chip ${tone}`, title }, icon(sign), h("span", {}, words));
}

/** Keep the children of `parent` in step with `items`: one element per key, updated in place, so that focus is kept. */
export function keyed(parent, items, keyOf, make, update) {
  const old = parent.keyed ?? new Map();
  const now = new Map();
  const focused = parent.contains(document.activeElement) ? document.activeElement : null;
  const stay = new Set(items.map(keyOf));
  for (const [key, element] of old) if (!stay.has(key)) element.remove(); // first: no other element has to move then
  let place = parent.firstChild;
  for (const item of items) {
    const key = keyOf(item);
    if (now.has(key)) continue;
    const element = old.get(key) ?? make(item);
    update?.(element, item);
    now.set(key, element);
    if (element === place) place = place.nextSibling;
    else parent.insertBefore(element, place);
  }
  parent.keyed = now;
  // an element that moves loses the focus
  if (focused?.isConnected && document.activeElement !== focused) focused.focus({ preventScroll: true });
}

let numbered = 0;

/** A labelled field; `control` gets an id that the label names. */
export function field(label, control, hint) {
  control.id ||= `field-${++numbered}`;
  const said = hint ? h("span", { class: "hint", id: `${control.id}-hint` }, hint) : null;
  if (said) control.setAttribute("aria-describedby", said.id);
  return h("div", { class: "field" }, h("label", { for: control.id }, label), control, said);
}

/** A button; `busy(promise)` disables it and shows that until the promise ends. */
export function button(words, props = {}, sign = null) {
  const element = h("button", { type: "button", ...props }, sign ? icon(sign) : null, h("span", {}, words));
  element.busy = async (work) => {
    if (element.getAttribute("aria-busy") === "true") return undefined;
    element.setAttribute("aria-busy", "true");
    element.disabled = true;
    try {
      return await work();
    } finally {
      element.removeAttribute("aria-busy");
      element.disabled = false;
    }
  };
  return element;
}

/** Announce a text to screen readers, politely. */
export function say(words) {
  text(document.getElementById("say"), words);
}

/** A notice at the edge: errors stay until closed, success disappears. */
export function toast(tone, words, hint) {
  const box = document.getElementById("toasts");
  const close = () => element.remove();
  const element = h(
    "div",
    { class: `toast ${tone}`, role: tone === "bad" ? "alert" : "status" },
    icon(tone === "bad" ? "warn" : "good"),
    h("div", {}, h("p", {}, words), hint ? h("p", { class: "hint" }, hint) : null),
    h("button", { type: "button", class: "quiet", "aria-label": "Close message", onclick: close }, icon("bad")),
  );
  while (box.childElementCount >= 4) box.firstChild.remove();
  box.append(element);
  if (tone !== "bad") setTimeout(close, 6000);
}

/** Cause and remedy, as a block inside a panel. */
export function trouble(error) {
  return h(
    "div",
    { class: "trouble", role: "alert" },
    icon("warn"),
    h("div", {}, h("p", {}, error.message), error.hint ? h("p", { class: "hint" }, error.hint) : null),
  );
}

/** What to do next, if there is nothing to show yet. */
export function empty(title, ...what) {
  return h("div", { class: "empty" }, h("p", { class: "lead" }, title), ...what);
}
