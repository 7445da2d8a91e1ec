// The jobs of the line with their progress; an open one shows each station: yield, seconds per step, failures.

import { get } from "../api.js";
import { chip, fill, h, keyed, text } from "../dom.js";
import { count } from "../format.js";
import { on, state } from "../state.js";

const EVERY = 10000; // ms

/** The panel, hidden if there is no job; `end` stops polling. */
export function linePanel() {
  const list = h("ul", { class: "lines jobs" });
  const panel = h("section", { class: "panel wide", "aria-label": "Line", hidden: true }, h("h3", {}, "Line"), list);
  const open = new Set();

  async function ask() {
    let jobs = [];
    try {
      jobs = state.status?.plant ? (await get("jobs")).jobs : [];
    } catch {
      return; // the connection line reports this
    }
    panel.hidden = !jobs.length;
    keyed(list, jobs.toReversed(), (one) => one.id, (one) => jobRow(one, open, askOne), (element, one) => element.paint(one));
    await Promise.all([...open].map(askOne));
  }

  async function askOne(id) {
    try {
      list.querySelector(`[data-job="${id}"]`)?.show(await get(`jobs/${id}`));
    } catch {
      // polled again soon
    }
  }

  const asking = setInterval(ask, EVERY);
  const off = on("status", () => panel.hidden && ask());
  ask();
  return {
    panel,
    end() {
      clearInterval(asking);
      off();
    },
  };
}

function jobRow(job, open, askOne) {
  const title = h("strong", {});
  const about = h("span", { class: "hint" });
  const sign = h("span", {});
  const done = h("div", { class: "stations" });
  const details = h("details", {}, h("summary", {}, h("span", { class: "grow" }, title, about), sign), done);
  details.addEventListener("toggle", () => {
    if (details.open) open.add(job.id), askOne(job.id);
    else open.delete(job.id);
  });
  const element = h("li", { "data-job": job.id }, details);
  element.paint = (one) => {
    text(title, one.title);
    text(about, ` ${one.passed} of ${one.total} passed here, ${one.profile}, until ${new Date(one.ends * 1000).toISOString().slice(0, 10)}`);
    const over = one.ends * 1000 < Date.now();
    fill(sign, chip(one.state === "open" && !over ? "good" : "plain", one.state === "open" && !over ? "good" : "warn", over ? "over" : one.state));
  };
  element.show = (one) => {
    const told = JSON.stringify(one.stations);
    if (done.told === told) return;
    done.told = told;
    fill(done, one.stations.map((part) => stationPart(part, one)));
  };
  return element;
}

/** One station: its boards as one bar, then a bar for each step and each failure. */
function stationPart(part, job) {
  const whole = Math.max(part.allotment, part.units, 1);
  const steps = Object.entries(part.steps);
  const worst = Math.max(...steps.map(([, one]) => one.worst), 0.001);
  const failures = Object.entries(part.failures);
  const most = Math.max(...failures.map(([, many]) => many), 1);
  const first = part.first_pass === null ? 0 : part.first_pass * part.units;
  return h(
    "section",
    { class: "station-part", "aria-label": `${part.name}, ${job.title}` },
    h("h4", {}, part.name, part.over ? chip("warn", "warn", "more than allotted") : null),
    bars("Boards", [["first pass", first / whole, "good", part.first_pass === null ? "no board yet" : `${(100 * part.first_pass).toFixed(1)} %`], ["passed", part.passed / whole, "good", `${part.passed} of ${part.units}`], ["begun", part.units / whole, "", `${part.units} of ${part.allotment}`]]),
    steps.length ? bars("Seconds, median and worst", steps.map(([name, one]) => [name, one.median / worst, "", `${one.median.toFixed(2)} · ${one.worst.toFixed(2)}`, one.worst / worst])) : h("p", { class: "hint" }, part.attempts ? "No step times: this station's evidence is not available here." : "No attempts yet."),
    failures.length ? bars("Failures", failures.map(([code, many]) => [code, many / most, "bad", count(many, "attempt")])) : null,
  );
}

/** Rows of [name, share, tone, words, farther share]. */
function bars(title, rows) {
  return h(
    "div",
    { class: "bars", role: "group", "aria-label": title },
    h("p", { class: "hint" }, title),
    h("dl", {}, rows.map(([name, share, tone, words, farther]) => [h("dt", {}, name), h("dd", {}, h("span", { class: "share", "aria-hidden": "true" }, farther ? length("farther", farther) : null, length(tone, share)), h("span", { class: "amount" }, words))])),
  );
}

function length(tone, share) {
  const one = h("i", { class: tone });
  // the page's content security policy forbids style in markup
  one.style.width = `${(100 * Math.min(1, Math.max(0, share))).toFixed(1)}%`;
  return one;
}
