// Filters of the node list: text, type, verdict, calibration, link, group.

import { fill, h, text } from "../dom.js";
import { nameOf } from "../format.js";
import { now } from "../state.js";
import { linkName } from "./facts.js";

const SOON = 30 * 86400; // s before a calibration ends

/** Name, text for "all", and a node's value (a word, or several). */
const CHOICES = [
  ["type", "Any type", (node) => node.profile ?? "no type"],
  ["verdict", "Any verdict", (node) => node.verdict ?? "not checked"],
  ["due", "Any calibration", (node) => dueOf(node)],
  ["link", "Any link", (node) => (node.present === false ? "away" : node.virtual ? "Virtual" : linkName(node.link))],
  ["group", "Any group", (node) => (node.groups?.length ? node.groups : "no group")],
];

function dueOf(node) {
  if (!node.due) return "no date";
  const left = Date.parse(node.due) / 1000 - now();
  return left < 0 ? "overdue" : left < SOON ? "due in 30 days" : "not due";
}

export class Filters {
  /** `changed` is called when the user changes a filter. */
  constructor(changed) {
    this.search = h("input", { type: "search", placeholder: "Name, UUID or type", "aria-label": "Search nodes", oninput: changed });
    this.selects = CHOICES.map(([name, all]) => h("select", { "aria-label": all.replace("Any ", "Filter by "), "data-filter": name, onchange: changed }, h("option", { value: "" }, all)));
    this.clear = h("button", { type: "button", class: "quiet", hidden: true, onclick: () => this.none(changed) }, "Clear filters");
    this.more = h("details", { class: "filters" }, h("summary", {}, "Filter"), h("div", { class: "filter-grid" }, this.selects));
    this.element = h("div", { class: "find" }, this.search, this.more, this.clear);
  }

  get on() {
    return Boolean(this.search.value.trim()) || this.selects.some((select) => select.value);
  }

  none(changed) {
    this.search.value = "";
    this.selects.forEach((select) => (select.value = ""));
    changed();
  }

  /** Return the matching nodes. Choices follow the nodes; a chosen one stays even if no node matches it any more. */
  of(nodes) {
    CHOICES.forEach(([, all, of], at) => {
      const select = this.selects[at];
      const words = [...new Set(nodes.flatMap(of))].sort((one, other) => one.localeCompare(other, undefined, { numeric: true }));
      if (select.value && !words.includes(select.value)) words.push(select.value);
      const told = words.join("\n");
      if (select.told === told) return;
      select.told = told;
      const chosen = select.value;
      fill(select, h("option", { value: "" }, all), words.map((word) => h("option", { value: word }, word)));
      select.value = chosen;
    });
    const words = this.search.value.trim().toLowerCase();
    const fits = (node) =>
      (!words || nameOf(node).toLowerCase().includes(words) || node.uuid.includes(words.replace(/\s/g, "")) || (node.profile ?? "").toLowerCase().includes(words)) &&
      CHOICES.every(([, , of], at) => !this.selects[at].value || [of(node)].flat().includes(this.selects[at].value));
    const chosen = this.selects.filter((select) => select.value).length;
    text(this.more.firstChild, chosen ? `Filter: ${chosen} chosen` : "Filter");
    this.clear.hidden = !this.on;
    return nodes.filter(fits);
  }
}
