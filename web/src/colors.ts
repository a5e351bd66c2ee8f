// The meaning of the colours of modules. They differ with the common kinds of colour blindness.

import type { ExpressionSpecification } from "maplibre-gl";
import type { Feature, ModuleProperties } from "./api";

export type ColorBy = "bench" | "row" | "status";

const BENCHES = ["#4477aa", "#66ccee", "#228833", "#ccbb44", "#ee6677", "#aa3377", "#88a0b8"];
const ROWS = ["#0b3c6f", "#2a78b5", "#7db8da", "#d3e5f0", "#f4a582", "#c95b45"];
const STATUS: Record<string, { color: string; meaning: string }> = {
  detected: { color: "#3b78b0", meaning: "seen in every view of its place" },
  confirmed: { color: "#e0a126", meaning: "inferred in some views, seen in others" },
  manual: { color: "#b3397f", meaning: "set by a person" },
};
const OTHER = "#8d939b";

/** The colour of a module by the properties that the map was given. */
export function expression(by: ColorBy): ExpressionSpecification {
  const cycle = (property: string, colors: string[]): ExpressionSpecification =>
    [
      "match",
      ["%", ["get", property], colors.length],
      ...colors.slice(1).flatMap((color, index) => [index + 1, color]),
      colors[0],
    ] as unknown as ExpressionSpecification;
  if (by === "bench") return cycle("benchIndex", BENCHES);
  if (by === "row") return cycle("rowIndex", ROWS);
  const statuses = Object.entries(STATUS).flatMap(([status, { color }]) => [status, color]);
  return ["match", ["get", "status"], ...statuses, OTHER] as unknown as ExpressionSpecification;
}

/** Colours and what they stand for. */
export function legend(by: ColorBy, modules: Feature<ModuleProperties>[]): { color: string; text: string }[] {
  const counts = new Map<string | number, number>();
  const key = (p: ModuleProperties) => (by === "row" ? p.row : p.status);
  for (const { properties } of modules) counts.set(key(properties), (counts.get(key(properties)) ?? 0) + 1);
  if (by === "bench") return [];
  const entries = [...counts].sort(([a], [b]) => (a < b ? -1 : 1));
  if (by === "row") {
    return entries.map(([row, count]) => ({
      color: ROWS[(Number(row) - 1) % ROWS.length] ?? OTHER,
      text: `row ${row}${row === 1 ? ", the northern" : ""}: ${count.toLocaleString()}`,
    }));
  }
  return entries.map(([status, count]) => ({
    color: STATUS[status]?.color ?? OTHER,
    text: `${status}: ${count.toLocaleString()}${STATUS[status] ? `, ${STATUS[status].meaning}` : ""}`,
  }));
}
