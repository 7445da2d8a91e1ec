// Virtual transducers: nodes in software, with their own key, fed by a source.

import { paths, post, remove } from "../api.js";
import { button, chip, empty, field, fill, h, icon, keyed, say, text, trouble } from "../dom.js";
import { count, nameOf } from "../format.js";
import { on, refresh, state } from "../state.js";
import { Feed } from "./feed.js";

export function virtualView(main) {
  const list = h("ul", { class: "groups" });
  const none = h("div", {});
  const type = h("select", {});
  const file = h("input", { type: "file", accept: ".xml,.json,application/xml,application/json" });
  const name = h("input", { type: "text", maxlength: "120", autocomplete: "off" });
  const source = h("select", {}, h("option", { value: "sine:5" }, "Sine, 5 s"), h("option", { value: "ramp:5" }, "Ramp, 5 s"), h("option", { value: "noise" }, "Noise"), h("option", { value: "simulation" }, "Simulation: a program, or values set here"));
  const make = button("Create", { class: "main", onclick: () => make.busy(() => create()) }, "plus");
  const error = h("div", { class: "stack" });
  main.append(
    h("h2", { class: "view-title" }, "Virtual transducers"),
    h("p", { class: "hint intro" }, "Nodes in software with a key and a UUID of their own. They behave like real nodes: same commands, same checks."),
    h(
      "div",
      { class: "columns" },
      h(
        "section",
        { class: "panel side-wide", "aria-label": "Create a virtual transducer" },
        h("h3", {}, "Create one"),
        h("div", { class: "stack" }, field("Transducer type", type), field("Or a datasheet file (XML or JSON)", file), field("Name", name), field("Value source", source), h("div", { class: "row" }, make), error),
      ),
      h("section", { class: "wide", "aria-label": "Virtual transducers" }, none, list),
    ),
  );

  function paint() {
    const names = state.profiles.map((one) => one.name).join("\n");
    if (type.told !== names) {
      type.told = names;
      const before = type.value;
      fill(type, h("option", { value: "" }, "Choose a type"), state.profiles.map((one) => h("option", { value: one.name }, one.title || one.name)));
      type.value = before;
    }
    const may = state.connection === "live" && state.status?.write !== false;
    if (make.getAttribute("aria-busy") !== "true") make.disabled = !may;
    for (const [uuid, element] of list.keyed ?? []) if (!state.virtual.some((one) => one.uuid === uuid)) element.feed?.end();
    keyed(list, state.virtual, (one) => one.uuid, (one) => card(one, paint), (element, one) => element.paint(one, may));
    if (state.virtual.length) none.replaceChildren();
    else if (!none.firstChild) fill(none, empty("No virtual transducers yet.", h("p", {}, "Choose a type on this page and press Create. It appears under Nodes like a real node.")));
  }

  async function create(newUuid = false) {
    error.replaceChildren();
    const chosen = file.files[0];
    if (!chosen && !type.value) {
      fill(error, trouble({ message: "A virtual transducer needs a datasheet.", hint: "Choose a transducer type, or a datasheet file." }));
      return;
    }
    try {
      const body = { name: name.value.trim() || null, source: source.value };
      if (chosen) {
        body.content = await chosen.text();
        body.format = body.content.trimStart().startsWith("<") ? "xml" : "json";
      } else body.profile = type.value;
      if (newUuid) body.new_uuid = true;
      const made = await post("virtual", body);
      file.value = name.value = "";
      say(`Virtual transducer ${made.name ?? ""} created.`);
      const link = h("a", { href: `#/nodes/${made.uuid}` }, nameOf(made));
      fill(error, h("p", { class: "done" }, chip("good", "good", "Created"), " ", link));
      if (newUuid) link.focus(); // the pressed button no longer exists
      await refresh("virtual", "nodes");
    } catch (refusal) {
      if (refusal.code !== "uuid-known") {
        fill(error, trouble(refusal));
        return;
      }
      const offer = h("button", { type: "button", onclick: () => make.busy(() => create(true)) }, "Create it with a new UUID");
      fill(error, trouble({ message: refusal.message, hint: "Two nodes with one UUID cannot be distinguished." }), h("div", { class: "row" }, offer));
    }
  }

  const off = on("virtual profiles status connection nodes", paint);
  refresh("profiles", "virtual");
  paint();
  return {
    end() {
      off();
      for (const element of list.keyed?.values() ?? []) element.feed?.end();
    },
  };
}

function card(one, changed) {
  const open = h("a", { href: `#/nodes/${one.uuid}` });
  const facts = h("p", { class: "facts" });
  const drop = button("Remove", { class: "quiet" }, "bad");
  const error = h("div", {});
  const element = h("li", { class: "panel group" }, h("div", { class: "panel-head" }, h("h4", {}, icon("virtual"), open), drop), facts, error);
  if (one.source === "simulation") {
    element.feed = new Feed(one.uuid);
    element.feed.changed = changed;
    element.append(element.feed.element);
  }
  let sure = false;
  drop.addEventListener("click", () => {
    if (!sure) {
      sure = true; // asks twice, because the key is deleted too
      text(drop.lastChild, "Delete this transducer and its key?");
      setTimeout(() => {
        sure = false;
        text(drop.lastChild, "Remove");
      }, 4000);
      return;
    }
    drop.busy(async () => {
      try {
        await remove(paths.virtual(one.uuid));
        say("Removed.");
        await refresh("virtual", "nodes");
      } catch (refusal) {
        fill(error, trouble(refusal));
      }
    });
  });
  element.paint = (now, may) => {
    text(open, nameOf(now));
    const channels = Array.isArray(now.channels) ? now.channels.length : now.channels;
    text(facts, [`source ${now.source ?? "unknown"}`, typeof channels === "number" ? count(channels, "channel") : null, now.state, now.uuid].filter(Boolean).join(" · "));
    if (drop.getAttribute("aria-busy") !== "true") drop.disabled = !may;
    element.feed?.paint(now, may);
  };
  return element;
}
