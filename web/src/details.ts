// Details of one module.

import type { Feature, ModuleProperties } from "./api";
import { h, plural } from "./dom";

const COMPASS = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];

/** What a section about a module holds. `name` gives the label of a line or bench. */
export function moduleDetails(
  { id, properties: p }: Feature<ModuleProperties>,
  name: (id: string) => string | undefined,
  close: () => void,
): Node[] {
  const [longitude, latitude, height] = p.center;
  const facing = COMPASS[Math.round(p.azimuth_deg / 45) % 8] ?? "";
  const sigma = p.sigma_m?.map((value) => value.toFixed(3)).join(" / ");
  const facts: [string, string | undefined][] = [
    ["Status", p.status],
    ["Line", name(p.line)],
    ["Bench", name(p.bench)],
    ["Row", `${p.row} from the north`],
    ["Number", `${p.number} from the west`],
    ["Tilt", `${p.tilt_deg.toFixed(1)}°`],
    ["Azimuth", `${p.azimuth_deg.toFixed(1)}° ${facing}`],
    ["Size", `${p.width_m.toFixed(3)} × ${p.height_m.toFixed(3)} m`],
    ["Centre", `${latitude.toFixed(7)}°, ${longitude.toFixed(7)}°, ${height.toFixed(2)} m`],
    ["Sigma E / N / up", sigma ? `${sigma} m` : undefined],
  ];
  const ids: [string, string][] = [
    ["Module", id],
    ["Sector", p.sector],
    ["Bench", p.bench],
    ["Line", p.line],
  ];
  return [
    h(
      "div",
      { class: "title" },
      h("h2", { id: "module-title" }, p.label),
      h("button", { type: "button", class: "plain", "aria-label": "Close the module", click: close }, "×"),
    ),
    h("dl", {}, ...facts.flatMap(([term, value]) => (value ? [h("dt", {}, term), h("dd", {}, value)] : []))),
    h(
      "details",
      {},
      h("summary", {}, `Seen in ${plural(p.views, "view")}`),
      h("ul", { class: "images" }, ...p.images.map((image) => h("li", {}, image))),
    ),
    h(
      "details",
      { open: true },
      h("summary", {}, "Identifiers"),
      h("dl", { class: "ids" }, ...ids.flatMap(([term, value]) => [h("dt", {}, term), h("dd", {}, value)])),
    ),
  ];
}
