// A fake service for trying the page without a real one: `npm run build && npm run fixture`.
// Its responses follow /openapi.yaml: made-up plants, a running mapping, a failed one, and a survey without any.

import { createHash } from "node:crypto";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";

const DIST = fileURLToPath(new URL("../dist/", import.meta.url));
const TYPES = { ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".css": "text/css" };

const uuid = (text) => {
  const hex = createHash("sha256").update(text).digest("hex");
  return `${hex.slice(0, 8)}-${hex.slice(8, 12)}-5${hex.slice(13, 16)}-a${hex.slice(17, 20)}-${hex.slice(20, 32)}`;
};

const pad = (number, digits) => String(number).padStart(digits, "0");

/** Layers of a plant of so many lines, benches and columns, two rows each, turned a little. */
function model(plant, lines, benches, columns) {
  const [longitude, latitude] = [14.0127, 49.8215];
  const position = (x, y, z) => {
    const [sin, cos] = [Math.sin(0.1), Math.cos(0.1)];
    const [east, north] = [cos * x - sin * y, sin * x + cos * y];
    const place = [longitude + east / 71_900, latitude + north / 111_230];
    return [...place.map((degrees) => Number(degrees.toFixed(9))), Number((412 + z).toFixed(4))];
  };
  const polygon = (west, east, south, north) => {
    const corners = [
      [west, south],
      [east, south],
      [east, north],
      [west, north],
    ];
    const ring = corners.map(([x, y]) => position(x, y, 0.4 * (y - south)));
    return { type: "Polygon", coordinates: [[...ring, ring[0]]] };
  };
  const feature = (id, geometry, properties) => ({
    type: "Feature",
    id,
    geometry,
    properties: { id, plant, ...properties },
  });
  const layers = { modules: [], benches: [], lines: [] };
  for (let l = 1; l <= lines; l++) {
    const line = uuid(`${plant} line ${l}`);
    const north = -8 * l;
    const label = `L${pad(l, 2)}`;
    const start = 0.7 * (l % 5);
    let west = start;
    for (let b = 1; b <= benches; b++) {
      const bench = uuid(`${plant} bench ${l} ${b}`);
      const benchLabel = `${label}-B${pad(b, 2)}`;
      const count = columns - ((l * b) % 4);
      for (let row = 1; row <= 2; row++) {
        const sector = uuid(`${plant} sector ${l} ${b} ${row}`);
        for (let number = 1; number <= count; number++) {
          const [x, y] = [west + 1.02 * (number - 1), north - 1.55 * row];
          const serial = layers.modules.length + 1;
          const status = serial % 41 === 0 ? "confirmed" : serial % 307 === 0 ? "manual" : "detected";
          const id = uuid(`${plant} module ${serial}`);
          layers.modules.push(
            feature(id, polygon(x, x + 1, y, y + 1.53), {
              label: `${benchLabel}-R${row}-${pad(number, 3)}`,
              line,
              bench,
              sector,
              row,
              number,
              center: position(x + 0.5, y + 0.76, 0.3),
              tilt_deg: 24.6 + (serial % 7) / 10,
              azimuth_deg: 174.3,
              width_m: 1.0,
              height_m: 1.65,
              sigma_m: [0.011, 0.012, 0.031],
              views: 3,
              images: ["DJI_0001.jpg", "DJI_0002.jpg", "DJI_0005.jpg"],
              status,
            }),
          );
        }
      }
      const east = west + 1.02 * count;
      const properties = { label: benchLabel, line, bench, modules: 2 * count, index: b, rows: 2, columns: count };
      layers.benches.push(feature(bench, polygon(west, east, north - 3.1, north), properties));
      west = east + 0.6;
    }
    const properties = { label, line, modules: 0, index: l, benches };
    layers.lines.push(feature(line, polygon(start, west - 0.6, north - 3.1, north), properties));
  }
  return layers;
}

/** The service, listening; resolves to its address and what ends it. */
export async function serve(port = 0) {
  const now = new Date(Date.UTC(2026, 5, 21, 9, 30)).toISOString();
  const plant = (name) => ({ id: uuid(name), name, created: now });
  const plants = [plant("Sunfield North"), plant("Sunfield South"), plant("Not yet mapped"), plant("Out of order")];
  const [north, south, bare, broken] = plants.map((plant) => plant.id);
  const layersOf = { [north]: model(north, 4, 3, 20), [south]: model(south, 30, 5, 19) };
  const survey = (plant, name) => ({ id: uuid(`${plant} ${name}`), plant, name, created: now });
  const surveysOf = {
    [north]: [
      survey(north, "2026-06-20 noon"),
      survey(north, "2026-06-21 morning"),
      survey(north, "2026-06-21 evening"),
    ],
    [south]: [survey(south, "2026-05-02")],
    [bare]: [],
  };
  const warnings = [
    {
      code: "unmatched_bench",
      message: "Bench L02-B03 was seen in one photo only; its place in the line is a guess.",
      images: ["DJI_0004.jpg"],
    },
    {
      code: "image_left_out",
      message: "Two photos from 75 m do not resolve modules and were left out of detection.",
      images: ["DJI_0009.jpg", "DJI_0010.jpg"],
    },
  ];
  const begun = new Map();
  const job = (survey, members) => ({
    id: uuid(`${survey} job`),
    survey,
    warnings: [],
    attempt: 1,
    max_attempts: 3,
    cancel_requested: false,
    created: now,
    ...members,
  });
  const stages = ["read", "detect", "layout", "locate", "fuse", "refine", "assemble"];
  /** The newest job of a survey: the first one failed, the second made model 2, the third runs from its first look. */
  const jobOf = (plant, id) => {
    const [failed, done, running] = (surveysOf[plant] ?? []).map((survey) => survey.id);
    if (plant === south) return job(id, { state: "succeeded", model_version: 1, finished: now });
    if (id === failed && !begun.has(id)) {
      const message = "images/DJI_0007.jpg is cut short: upload it again";
      return job(id, { state: "failed", error: { code: "image_truncated", message }, finished: now });
    }
    if (id === done) return job(id, { state: "succeeded", model_version: 2, finished: now });
    if (id === running && !begun.has(id)) begun.set(id, Date.now());
    const seconds = (Date.now() - begun.get(id)) / 1000;
    if (seconds < 1) return job(id, { state: "queued" });
    const at = Math.floor((seconds - 1) * 7);
    if (at >= 70) return job(id, { state: "succeeded", model_version: 3, finished: new Date().toISOString() });
    const [stage, done_] = [Math.floor(at / 10), at % 10];
    return job(id, {
      state: "running",
      progress: { stage: stages[stage], stage_number: stage + 1, stage_count: 7, done: done_, total: 10 },
    });
  };
  const problem = (status, code, title, detail) => [
    status,
    { type: `urn:heliomap:problem:${code}`, title, status, code, detail },
  ];
  const versionsOf = (id) => {
    if (!layersOf[id]) return [];
    const newest =
      id === south ? 1 : [...begun.keys()].some((survey) => jobOf(id, survey).state === "succeeded") ? 3 : 2;
    return Array.from({ length: newest }, (_, index) => newest - index);
  };

  const answer = (method, url) => {
    const parts = url.pathname.split("/").slice(3);
    const [kind, id, what, which, layer] = parts;
    if (kind !== "plants") return problem(404, "not_found", "There is nothing here", "See /openapi.yaml.");
    if (!id) return [200, { items: plants }];
    if (id === broken) return problem(500, "internal_error", "The service failed", "This is a fault of the service.");
    if (what === "surveys" && !which) return [200, { items: surveysOf[id] }];
    if (what === "surveys" && layer === "jobs") {
      if (method === "POST") begun.set(which, Date.now());
      return method === "POST" ? [202, jobOf(id, which)] : [200, { items: [jobOf(id, which)] }];
    }
    if (what === "surveys") {
      const files = [1, 2, 3].map((n) => ({ path: `images/DJI_000${n}.jpg`, kind: "image", size: 364_000 }));
      files.push({ path: "reconstruction.json", kind: "reconstruction", size: 1_400_000 });
      return [200, { ...surveysOf[id].find((survey) => survey.id === which), complete: true, missing: [], files }];
    }
    const view = (version) => ({
      plant: id,
      version,
      survey: "s",
      job: "j",
      warnings: id === north ? warnings : [],
      created: now,
    });
    if (what === "models" && !which) return [200, { items: versionsOf(id).map(view) }];
    if (what === "models" && !layer) {
      const layers = Object.entries(layersOf[id]).map(([layer, features]) => ({
        layer,
        features: features.length,
        href: `/api/v1/plants/${id}/models/${which}/${layer}`,
      }));
      return [200, { ...view(Number(which)), layers }];
    }
    if (what === "models") {
      const features = layersOf[id][layer];
      const [limit, cursor] = [
        Number(url.searchParams.get("limit")) || 1e9,
        Number(url.searchParams.get("cursor")) || 0,
      ];
      const end = cursor + limit;
      const links =
        end < features.length ? [{ rel: "next", href: `${url.pathname}?limit=${limit}&cursor=${end}` }] : undefined;
      return [200, { type: "FeatureCollection", links, features: features.slice(cursor, end) }];
    }
    return problem(404, "not_found", "There is nothing here", "See /openapi.yaml.");
  };

  const server = createServer(async (request, response) => {
    const url = new URL(request.url, "http://localhost");
    if (url.pathname.startsWith("/api/")) {
      const [status, body] = answer(request.method, url);
      response.writeHead(status, { "content-type": status < 400 ? "application/json" : "application/problem+json" });
      response.end(JSON.stringify(body));
      return;
    }
    const path = normalize(url.pathname === "/" ? "/index.html" : url.pathname);
    try {
      const body = await readFile(join(DIST, path));
      response.writeHead(200, { "content-type": TYPES[extname(path)] ?? "application/octet-stream" });
      response.end(body);
    } catch {
      response.writeHead(404).end();
    }
  });
  await new Promise((resolve) => server.listen(port, "127.0.0.1", resolve));
  return {
    url: `http://127.0.0.1:${server.address().port}/`,
    close: () => {
      server.closeAllConnections();
      server.close();
    },
  };
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  console.log((await serve(Number(process.env.PORT ?? 8090))).url);
}
