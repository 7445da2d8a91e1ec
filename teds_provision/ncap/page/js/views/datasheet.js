// The datasheet tab: read and decoded with its security check and curves; written from a file, the diff first.

import { get, paths, post } from "../api.js";
import { button, chip, empty, field, fill, h, say, trouble } from "../dom.js";
import { count, nameOf, verdict } from "../format.js";
import { curvePlot } from "../plot.js";
import { on, refresh, state } from "../state.js";
import { checkLine } from "./facts.js";
import { WritePanel } from "./write.js";

export class DatasheetTab {
  constructor(parent, uuid) {
    this.uuid = uuid;
    this.leaving = new AbortController();
    this.read = button("Read from node", { class: "main" }, "list");
    this.read.addEventListener("click", () => this.load());
    this.files = h("span", { class: "links" });
    this.body = h("div", { "aria-live": "off" });
    this.write = new WritePanel(uuid, () => this.load());
    parent.append(
      h("section", { class: "panel", "aria-label": "Datasheet" }, h("div", { class: "panel-head" }, h("h3", {}, "Datasheet (TEDS)"), this.read, this.files), this.body),
      this.write.element,
    );
    this.off = on("connection nodes", () => this.paint());
    this.paint();
    if (state.connection === "live") this.load();
    else fill(this.body, empty("Not read yet.", h("p", {}, "Press Read from node.")));
  }

  paint() {
    if (this.read.getAttribute("aria-busy") !== "true") this.read.disabled = state.connection !== "live";
    this.write.paint();
    const judged = state.nodes.get(this.uuid)?.verdict;
    // If the verdict of this reading differs from the node's present one, load the datasheet again.
    if (this.judged !== undefined && judged !== undefined && judged !== this.judged && state.connection === "live") this.load();
  }

  async load() {
    this.judged = undefined;
    await this.read.busy(async () => {
      if (!this.body.querySelector(".teds")) fill(this.body, h("p", { class: "empty busy-line" }, "Reading and verifying the datasheet …"));
      try {
        const sheet = await get(paths.teds(this.uuid), { signal: this.leaving.signal });
        this.show(sheet);
        say(`Datasheet of ${nameOf(state.nodes.get(this.uuid))} read.`);
        await refresh("nodes");
      } catch (error) {
        if (error.name !== "AbortError") fill(this.body, trouble(error));
      }
    });
    this.judged = state.nodes.get(this.uuid)?.verdict;
    this.paint();
  }

  show(sheet) {
    const api = paths.teds(this.uuid);
    fill(this.files, "Save as ", ["json", "xml", "hex"].map((form) => [h("a", { href: `api/v1/${api}?format=${form}`, download: `${this.uuid}.${form}` }, form.toUpperCase()), " "]));
    const teds = sheet.teds ?? [];
    const [tone, sign, words, why] = verdict(sheet.read_now === false ? { ...sheet, present: false, read: state.nodes.get(this.uuid)?.read } : sheet);
    const found = teds.flatMap((one) => (one.findings ?? []).map((finding) => ({ ...finding, where: title(one) })));
    const findings = [...(sheet.guard ?? []).map((one) => ({ ...one, where: "Plausibility" })), ...found];
    fill(
      this.body,
      h("div", { class: "sheet-verdict" }, chip(tone, sign, words), h("span", {}, why), sheet.read_now === false ? chip("warn", "clock", "Last reading: the node is not connected now") : null),
      sheet.checks?.length ? h("details", { class: "checks", open: sheet.verdict !== "authentic" }, h("summary", {}, "Security check"), h("ul", {}, sheet.checks.map(checkLine))) : null,
      findings.length ? h("details", { class: "findings", open: findings.some((one) => one.severity === "error") }, h("summary", {}, `${count(findings.length, "finding")}`), h("ul", {}, findings.map(findingLine))) : null,
      sheet.verdict === "unsigned" && sheet.read_now !== false && teds.some((one) => one.name === "ChanTEDS") ? this.brought(findings) : null,
      teds.length ? null : empty("The node has no datasheet.", h("p", {}, "Write one from a file below, or ", h("a", { href: `#/nodes/${this.uuid}/provision` }, "provision it"), " from a type.")),
      h("div", { class: "curves" }, (sheet.curves ?? []).map((curve) => figure(curve))),
      h("div", { class: "teds" }, teds.map((one) => tedsBlock(one, teds.length))),
    );
  }

  /** A factory datasheet: a click signs it; with findings, a reason is needed. */
  brought(findings) {
    const wrong = findings.some((one) => one.severity === "error");
    const reason = h("input", { type: "text", maxlength: "500", autocomplete: "off" });
    const result = h("div", {});
    const yes = button("Sign this datasheet", { class: "main" }, "good");
    yes.disabled = state.connection !== "live" || state.status?.write === false;
    yes.addEventListener("click", () =>
      yes.busy(async () => {
        try {
          const answer = await post(paths.provision(this.uuid), { adopt: true, accept_calibration: reason.value.trim() || null });
          state.runs.set(this.uuid, { steps: [], ...answer });
          location.hash = `#/nodes/${this.uuid}/provision`;
        } catch (error) {
          fill(result, trouble(error));
        }
      }),
    );
    return h(
      "div",
      { class: "brought", role: "group", "aria-label": "The board's own datasheet" },
      h("p", {}, "The board brought this datasheet, and nobody has signed it. Review it below. If it is correct, sign it to put the node into service."),
      h("div", { class: "row" }, wrong ? field("Reason to accept it despite the findings", reason) : null, yes),
      result,
    );
  }

  end() {
    this.leaving.abort();
    this.off();
    this.write.end();
  }
}

const NAMES = {
  MetaTEDS: "Meta-TEDS",
  ChanTEDS: "TransducerChannel TEDS",
  CalTEDS: "Calibration TEDS",
  XdcrName: "Name TEDS",
  SecurityTEDS: "Security TEDS",
  PHYTEDS: "PHY TEDS",
};
const title = (one) => [one.channel === 0 ? "Node" : `Channel ${one.channel}`, NAMES[one.name] ?? one.name].filter(Boolean).join(": ");

function findingLine(finding) {
  const tone = { error: "bad", warning: "warn" }[finding.severity] ?? "plain";
  return h("li", {}, chip(tone, tone === "plain" ? "ask" : "warn", finding.severity ?? "note"), h("span", { class: "check-name" }, finding.where), h("span", {}, finding.message, finding.hint ? h("span", { class: "hint" }, ` ${finding.hint}`) : null));
}

function figure(curve) {
  const drawn = curve.points.filter(([, y]) => y !== null); // null: the gap at the end of an angle's turn
  const [first, last] = [drawn[0], drawn.at(-1)];
  const words = `Calibration of ${curve.name}: from ${first?.join(" to ")} up to ${last?.join(" to ")}`;
  return h("figure", {}, h("figcaption", {}, `Calibration of ${curve.name}`), curvePlot(words, curve.x_unit, curve.y_unit, curve.points));
}

function tedsBlock(one, many) {
  const rows = h("tbody", {});
  (one.fields ?? []).forEach((field) => fieldRows(rows, field, 0));
  const state_ = one.verdict && one.verdict !== "clean" ? chip("warn", "warn", one.verdict) : null;
  return h(
    "details",
    { open: many <= 2 },
    h("summary", {}, title(one), " ", state_, h("span", { class: "hint" }, ` ${count((one.fields ?? []).length, "field")}`)),
    h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": title(one) }, h("table", { class: "fields" }, h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Field"), h("th", { scope: "col" }, "Value"))), rows)),
  );
}

function fieldRows(rows, field, depth) {
  const row = h("tr", {}, h("th", { scope: "row" }, field.name ?? `field ${field.type}`), h("td", {}, field.text ?? "", field.meaning && field.meaning !== field.text ? h("span", { class: "hint" }, ` ${field.meaning}`) : null));
  row.firstChild.style.setProperty("padding-inline-start", `${0.5 + depth}rem`);
  rows.append(row);
  (field.fields ?? []).forEach((inner) => fieldRows(rows, inner, depth + 1));
}

