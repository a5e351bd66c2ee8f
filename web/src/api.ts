// The service's interface, as /openapi.yaml describes it.

export interface Plant {
  id: string;
  name: string;
  created: string;
}

export interface Warning {
  code: string;
  message: string;
  images: string[];
}

export interface Model {
  plant: string;
  version: number;
  survey: string;
  warnings: Warning[];
  created: string;
}

export interface Layer {
  layer: string;
  features: number;
  bbox?: [number, number, number, number];
  href: string;
}

export interface ModelDetail extends Model {
  layers: Layer[];
}

export interface Survey {
  id: string;
  plant: string;
  name: string;
  created: string;
}

export interface SurveyDetail extends Survey {
  complete: boolean;
  missing: { code: string; message: string }[];
  images: { uploaded: number; reconstructed?: number; not_reconstructed_count: number };
  files: { path: string; kind: string; size: number }[];
}

/** A photo of a survey with its verdict. */
export interface Photo {
  name: string;
  warnings?: { code: string; message: string }[];
}

/** Where a photo was taken. */
export interface PhotoPosition {
  type: "Feature";
  id: string;
  geometry: { type: "Point"; coordinates: number[] };
  properties: { name: string; taken: string | null; reconstructed: boolean | null; warnings: string[] };
}

export interface Job {
  id: string;
  survey: string;
  state: "queued" | "running" | "succeeded" | "failed" | "cancelled";
  cancel_requested: boolean;
  progress?: { stage: string; stage_number: number; stage_count: number; done: number; total: number };
  error?: { code: string; message: string };
  model_version?: number;
  created: string;
  finished?: string;
}

export interface ModuleProperties {
  id: string;
  label: string;
  line: string;
  bench: string;
  sector: string;
  row: number;
  number: number;
  center: [number, number, number];
  tilt_deg: number;
  azimuth_deg: number;
  width_m: number;
  height_m: number;
  sigma_m?: [number, number, number] | null;
  views: number;
  images: string[];
  status: string;
}

export interface GroupProperties {
  id: string;
  label: string;
  line: string;
  modules: number;
}

export type Position = [number, number, number];

export interface Feature<P> {
  type: "Feature";
  id: string;
  geometry: { type: "Polygon"; coordinates: Position[][] } | null;
  properties: P;
}

interface Collection<P> {
  features: Feature<P>[];
  links?: { rel: string; href: string }[];
}

interface List<T> {
  items: T[];
  next?: string;
}

/** What went wrong, in the service's own words where it has any (RFC 9457). */
export class Problem extends Error {
  constructor(
    readonly title: string,
    readonly detail: string,
    readonly code: string,
  ) {
    super(`${title}: ${detail}`);
  }
}

/** Where the key lies until the tab is closed. */
const KEY = "heliomap-key";

/** From now on requests show this key. */
export const useKey = (key: string) => sessionStorage.setItem(KEY, key);

const ROOT = "/api/v1";
/** Modules per request. */
const PART = 5000;

async function request<T>(path: string, init: RequestInit = {}): Promise<T> {
  let response: Response;
  const key = sessionStorage.getItem(KEY);
  try {
    response = await fetch(path, key ? { ...init, headers: { authorization: `Bearer ${key}` } } : init);
  } catch (error) {
    if (init.signal?.aborted) throw error;
    throw new Problem("The service does not answer", "Check that it runs and that the network is up.", "unreachable");
  }
  const body: unknown = await response.json().catch(() => undefined);
  if (response.ok && body !== undefined) return body as T;
  const told = (body ?? {}) as { title?: string; detail?: string; code?: string };
  throw new Problem(
    told.title ?? `The service answered ${response.status}`,
    told.detail ?? "Its answer could not be read.",
    told.code ?? String(response.status),
  );
}

async function all<T>(path: string, signal?: AbortSignal, filter = ""): Promise<T[]> {
  const items: T[] = [];
  let next: string | undefined = `${ROOT}${path}?limit=1000${filter}`;
  while (next) {
    const part: List<T> = await request<List<T>>(next, signal ? { signal } : {});
    items.push(...part.items);
    next = part.next;
  }
  return items;
}

export const listPlants = () => all<Plant>("/plants");
export const listModels = (plant: string, signal?: AbortSignal) => all<Model>(`/plants/${plant}/models`, signal);
export const listSurveys = (plant: string, signal?: AbortSignal) => all<Survey>(`/plants/${plant}/surveys`, signal);
export const getSurvey = (survey: Survey) =>
  request<SurveyDetail>(`${ROOT}/plants/${survey.plant}/surveys/${survey.id}`);
export const listWarnedPhotos = (survey: Survey) =>
  all<Photo>(`/plants/${survey.plant}/surveys/${survey.id}/images`, undefined, "&warning=any");
export const getPhotoPositions = async (survey: Survey) =>
  (await request<{ features: PhotoPosition[] }>(`${ROOT}/plants/${survey.plant}/surveys/${survey.id}/images.geojson`)).features;
export const getModel = (plant: string, version: number, signal: AbortSignal) =>
  request<ModelDetail>(`${ROOT}/plants/${plant}/models/${version}`, { signal });

/** The newest job of a survey. */
export async function latestJob(survey: Survey): Promise<Job | undefined> {
  const path = `${ROOT}/plants/${survey.plant}/surveys/${survey.id}/jobs?limit=1`;
  return (await request<List<Job>>(path)).items[0];
}

export const startJob = (survey: Survey) =>
  request<Job>(`${ROOT}/plants/${survey.plant}/surveys/${survey.id}/jobs`, { method: "POST" });
export const cancelJob = (survey: Survey, job: Job) =>
  request<Job>(`${ROOT}/plants/${survey.plant}/jobs/${job.id}/cancel`, { method: "POST" });

/** A whole layer, part by part; `progress` hears how many features are there. */
export async function getLayer<P>(
  layer: Layer,
  signal: AbortSignal,
  progress: (features: number) => void = () => {},
): Promise<Feature<P>[]> {
  const features: Feature<P>[] = [];
  let next: string | undefined = `${layer.href}?limit=${PART}`;
  while (next) {
    const part: Collection<P> = await request<Collection<P>>(next, { signal });
    for (const feature of part.features) features.push(feature);
    progress(features.length);
    next = part.links?.find((link) => link.rel === "next")?.href;
  }
  return features;
}
