// A station without links: reports that it finds no boards, and how to add a link.

import { h } from "../dom.js";
import { state } from "../state.js";

/** True if no link to boards is configured; the bus of virtual transducers does not count. */
export const isLinkless = () => state.status !== null && !state.status.links.some((link) => !link.virtual);

/** How to add a link; hidden at first. */
export const noLink = () => h("p", { class: "warn-line", "data-linkless": true, hidden: true }, "No link is configured, so no board is found. To add one, start the service with it: ", h("code", {}, "teds-provision ncap run --can socketcan:can0"), " (or ", h("code", {}, "--nfc usb"), ", ", h("code", {}, "--ble hci0"), ").");
