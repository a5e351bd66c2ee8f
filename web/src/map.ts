// The plant from above: modules, outlines of benches and lines, labels. Nothing is fetched from other hosts.

import {
  type GeoJSONSource,
  LngLatBounds,
  Map as MapLibre,
  NavigationControl,
  ScaleControl,
  setWorkerUrl,
} from "maplibre-gl";
import "maplibre-gl/dist/maplibre-gl.css";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?url";
import type { Feature, GroupProperties, ModuleProperties, PhotoPosition, Position } from "./api";
import { type ColorBy, expression } from "./colors";

setWorkerUrl(workerUrl);

export interface PlantLayers {
  modules: Feature<ModuleProperties>[];
  benches: Feature<GroupProperties>[];
  lines: Feature<GroupProperties>[];
}

type Collection = { type: "FeatureCollection"; features: object[] };
const collection = (features: object[]): Collection => ({ type: "FeatureCollection", features });
const FONT = ["sans-serif"];
const INK = "#1d2733";

export class PlantMap {
  private readonly map: MapLibre;
  private readonly ready: Promise<unknown>;
  private selected: string | undefined;
  private hovered: string | undefined;
  private bounds: LngLatBounds | undefined;

  /** Draws into `container`; `pick` hears of the module that was clicked, or of none. Throws without WebGL. */
  constructor(container: HTMLElement, pick: (id: string | undefined) => void) {
    this.map = new MapLibre({
      container,
      attributionControl: false,
      maxZoom: 24,
      maxPitch: 0,
      dragRotate: true,
      style: {
        version: 8,
        sources: {
          modules: { type: "geojson", data: collection([]) as never, promoteId: "id", maxzoom: 20, tolerance: 0 },
          outlines: { type: "geojson", data: collection([]) as never, maxzoom: 20, tolerance: 0 },
          labels: { type: "geojson", data: collection([]) as never },
          photos: { type: "geojson", data: collection([]) as never },
        },
        layers: [
          { id: "ground", type: "background", paint: { "background-color": "#eceae4" } },
          {
            id: "lines",
            type: "line",
            source: "outlines",
            filter: ["==", ["get", "kind"], "line"],
            paint: {
              "line-color": "#8a8578",
              "line-width": 1.5,
              "line-dasharray": [3, 3],
              "line-offset": ["interpolate", ["linear"], ["zoom"], 16, -1, 20, -6],
            },
          },
          {
            id: "modules",
            type: "fill",
            source: "modules",
            paint: { "fill-color": expression("bench"), "fill-antialias": true },
          },
          {
            id: "module-edges",
            type: "line",
            source: "modules",
            minzoom: 17.5,
            paint: {
              "line-color": "#ffffff",
              "line-width": ["interpolate", ["linear"], ["zoom"], 17.5, 0.3, 21, 1.2],
            },
          },
          {
            id: "benches",
            type: "line",
            source: "outlines",
            filter: ["==", ["get", "kind"], "bench"],
            paint: { "line-color": INK, "line-width": ["interpolate", ["linear"], ["zoom"], 16, 0.6, 20, 1.6] },
          },
          {
            id: "marked",
            type: "line",
            source: "modules",
            paint: {
              "line-color": "#ff7a00",
              "line-width": [
                "case",
                ["boolean", ["feature-state", "selected"], false],
                4,
                ["boolean", ["feature-state", "hovered"], false],
                2,
                0,
              ],
            },
          },
          {
            id: "photos",
            type: "circle",
            source: "photos",
            paint: {
              "circle-radius": ["interpolate", ["linear"], ["zoom"], 14, 3, 20, 7],
              // Red: the photo has a warning. White: the reconstruction does not use it.
              "circle-color": ["case", ["get", "warned"], "#d1495b", ["get", "left"], "#ffffff", INK],
              "circle-stroke-color": INK,
              "circle-stroke-width": 1.5,
            },
          },
          {
            id: "photo-names",
            type: "symbol",
            source: "photos",
            minzoom: 17,
            layout: {
              "text-field": ["get", "name"],
              "text-font": FONT,
              "text-size": 11,
              "text-anchor": "top",
              "text-offset": [0, 0.7],
            },
            paint: { "text-color": INK, "text-halo-color": "#ffffff", "text-halo-width": 1.5 },
          },
          {
            id: "numbers",
            type: "symbol",
            source: "modules",
            minzoom: 21,
            layout: { "text-field": ["to-string", ["get", "number"]], "text-font": FONT, "text-size": 11 },
            paint: { "text-color": INK, "text-halo-color": "#ffffff", "text-halo-width": 1.5 },
          },
          {
            id: "bench-labels",
            type: "symbol",
            source: "labels",
            filter: ["==", ["get", "kind"], "bench"],
            minzoom: 18.4,
            layout: {
              "text-field": ["get", "label"],
              "text-font": FONT,
              "text-size": 12,
              "text-anchor": "bottom",
              "text-offset": [0, -0.7],
            },
            paint: { "text-color": INK, "text-halo-color": "#eceae4", "text-halo-width": 2 },
          },
          {
            id: "line-labels",
            type: "symbol",
            source: "labels",
            filter: ["==", ["get", "kind"], "line"],
            layout: {
              "text-field": ["get", "label"],
              "text-font": FONT,
              "text-size": 14,
              "text-anchor": "right",
              "text-offset": [-0.8, 0],
            },
            paint: { "text-color": "#6b4f00", "text-halo-color": "#eceae4", "text-halo-width": 2 },
          },
        ],
      },
    });
    this.map.addControl(new NavigationControl({ visualizePitch: false }), "top-right");
    this.map.addControl(new ScaleControl({ maxWidth: 160 }), "bottom-left");
    this.ready = new Promise((resolve) => this.map.once("load", resolve));
    // For tests: whether everything is drawn.
    this.map.on("render", () => (container.dataset.drawn = "partly"));
    this.map.on("idle", () => (container.dataset.drawn = "all"));
    this.map.on("mousemove", (event) => this.hover(this.moduleAt(event.point)));
    this.map.on("mouseout", () => this.hover(undefined));
    this.map.on("click", (event) => pick(this.moduleAt(event.point)));
  }

  private moduleAt(point: { x: number; y: number }): string | undefined {
    const [found] = this.map.queryRenderedFeatures([point.x, point.y], { layers: ["modules"] });
    return found?.id === undefined ? undefined : String(found.id);
  }

  private mark(id: string | undefined, state: Record<string, boolean>): void {
    if (id !== undefined) this.map.setFeatureState({ source: "modules", id }, state);
  }

  private hover(id: string | undefined): void {
    if (id === this.hovered) return;
    this.mark(this.hovered, { hovered: false });
    this.mark(id, { hovered: true });
    this.hovered = id;
    this.map.getCanvas().style.cursor = id ? "pointer" : "";
  }

  /** Shows other modules, and all of them. */
  async show(layers: PlantLayers): Promise<void> {
    await this.ready;
    this.hovered = this.selected = undefined;
    this.map.removeFeatureState({ source: "modules" });
    const benchIndex = new Map(layers.benches.map((bench, index) => [bench.id, index]));
    const bounds = new LngLatBounds();
    const modules = layers.modules.map(({ id, geometry, properties: p }) => {
      for (const position of geometry?.coordinates[0] ?? []) bounds.extend([position[0], position[1]]);
      // The worker gets only the properties that it draws.
      const properties = {
        id,
        benchIndex: benchIndex.get(p.bench) ?? 0,
        rowIndex: Math.max(0, p.row - 1),
        status: p.status,
        number: p.number,
      };
      return { type: "Feature", id, geometry, properties };
    });
    const outlines = (features: Feature<GroupProperties>[], kind: string) =>
      features
        .filter((feature) => feature.geometry)
        .map(({ geometry, properties }) => ({
          type: "Feature",
          geometry,
          properties: { kind, label: properties.label },
        }));
    const labels = (features: Feature<GroupProperties>[], kind: string, place: (ring: Position[]) => Position) =>
      features
        .filter((feature) => feature.geometry)
        .map(({ geometry, properties }) => ({
          type: "Feature",
          geometry: { type: "Point", coordinates: place(geometry?.coordinates[0] ?? []) },
          properties: { kind, label: properties.label },
        }));
    // Rings run south-west, south-east, north-east, north-west.
    const north = (ring: Position[]) => middle(ring[2], ring[3]);
    const west = (ring: Position[]) => middle(ring[0], ring[3]);
    this.setData("modules", modules);
    this.setData("outlines", [...outlines(layers.lines, "line"), ...outlines(layers.benches, "bench")]);
    this.setData("labels", [...labels(layers.lines, "line", west), ...labels(layers.benches, "bench", north)]);
    this.bounds = bounds.isEmpty() ? undefined : bounds;
    this.fit();
  }

  /** Shows where photos were taken, in place of those before. */
  async showPhotos(photos: PhotoPosition[]): Promise<void> {
    await this.ready;
    const features = photos.map(({ geometry, properties: { name, warnings, reconstructed } }) => ({
      type: "Feature",
      geometry,
      properties: { name, warned: warnings.length > 0, left: reconstructed === false },
    }));
    this.setData("photos", features);
    if (features.length === 0) return;
    const bounds = new LngLatBounds();
    for (const { geometry } of photos) bounds.extend([geometry.coordinates[0] ?? 0, geometry.coordinates[1] ?? 0]);
    if (this.bounds) bounds.extend(this.bounds);
    this.map.fitBounds(bounds, { padding: 60, animate: false, maxZoom: 20 });
  }

  private setData(source: string, features: object[]): void {
    this.map.getSource<GeoJSONSource>(source)?.setData(collection(features) as never);
  }

  /** Shows the whole plant. */
  fit(): void {
    if (this.bounds) this.map.fitBounds(this.bounds, { padding: 60, animate: false, maxZoom: 22 });
  }

  async colorBy(by: ColorBy): Promise<void> {
    await this.ready;
    this.map.setPaintProperty("modules", "fill-color", expression(by));
  }

  /** Marks a module, and goes there where it is out of sight. */
  async select(feature: Feature<ModuleProperties> | undefined): Promise<void> {
    await this.ready;
    this.mark(this.selected, { selected: false });
    this.selected = feature?.id;
    this.mark(this.selected, { selected: true });
    if (!feature) return;
    const [longitude, latitude] = feature.properties.center;
    if (!this.map.getBounds().contains([longitude, latitude]) || this.map.getZoom() < 19) {
      const calm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.map.easeTo({ center: [longitude, latitude], zoom: Math.max(20, this.map.getZoom()), animate: !calm });
    }
  }
}

function middle(a: Position | undefined, b: Position | undefined): Position {
  if (!a || !b) return [0, 0, 0];
  return [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2, 0];
}
