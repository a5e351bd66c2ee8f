import {
  type Feature,
  type GroupProperties,
  getLayer,
  getModel,
  listModels,
  listPlants,
  type ModelDetail,
  type ModuleProperties,
  Problem,
  useKey,
} from "./api";
import { type ColorBy, legend } from "./colors";
import { moduleDetails } from "./details";
import { byId, h, moment, plural } from "./dom";
import { PlantMap } from "./map";
import { errorText, Surveys } from "./surveys";
import "./style.css";

const MAX_RESULTS = 30;

const plants = byId<HTMLSelectElement>("plants");
const models = byId<HTMLSelectElement>("models");
const search = byId<HTMLInputElement>("search");
const status = byId("status");

/** What is shown. The address bar says the same, so that a link leads back here. */
const shown = {
  plant: "",
  modules: [] as Feature<ModuleProperties>[],
  moduleOfId: new Map<string, Feature<ModuleProperties>>(),
  nameOfId: new Map<string, string>(),
  colorBy: "bench" as ColorBy,
  selected: undefined as string | undefined,
};
let loading = new AbortController();

const map = openMap();
const surveys = new Surveys(
  byId("surveys"),
  (plant, version) => {
    // Identifiers outlive models: the selected module stays selected.
    if (plant === plants.value) void attempt(() => openPlant(plant, version, shown.selected));
  },
  (photos) => void map?.showPhotos(photos),
);

function openMap(): PlantMap | undefined {
  try {
    return new PlantMap(byId("map"), (id) => select(id));
  } catch (error) {
    byId("map").replaceChildren(
      h(
        "p",
        {},
        `The map needs WebGL, which this browser does not offer (${error}). Search and details work without the map.`,
      ),
    );
    return undefined;
  }
}

/** Does something that may fail, and says so with a way to try again. */
async function attempt(action: () => Promise<void>): Promise<void> {
  const place = byId("problem");
  try {
    await action();
    place.hidden = true;
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") return;
    if (error instanceof Problem && error.code === "unauthorized") {
      place.replaceChildren(askForKey(() => void attempt(action)));
    } else {
      const retry = h("button", { type: "button", click: () => void attempt(action) }, "Try again");
      const code = error instanceof Problem ? h("code", {}, error.code) : undefined;
      place.replaceChildren(h("span", {}, errorText(error)), ...(code ? [code] : []), retry);
    }
    place.hidden = false;
    status.textContent = "";
  }
}

/** A form for the key that the service asks for. */
function askForKey(then: () => void): HTMLFormElement {
  const key = h("input", {
    type: "password",
    "aria-label": "Key",
    placeholder: "hm_…",
    autocomplete: "off",
    required: true,
  });
  const go = (event: Event) => {
    event.preventDefault();
    useKey(key.value.trim());
    then();
  };
  return h(
    "form",
    { submit: go },
    h("span", {}, "This service requires a key with the scope read. "),
    key,
    h("button", {}, "Continue"),
  );
}

function remember(): void {
  const place = new URLSearchParams();
  if (plants.value) place.set("plant", plants.value);
  if (models.value) place.set("model", models.value);
  if (shown.selected) place.set("module", shown.selected);
  history.replaceState(null, "", `#${place}`);
}

async function start(): Promise<void> {
  const address = new URLSearchParams(location.hash.slice(1));
  status.textContent = "Loading …";
  const found = await listPlants();
  plants.replaceChildren(...found.map((plant) => h("option", { value: plant.id }, plant.name)));
  plants.disabled = found.length === 0;
  if (found.length === 0) {
    status.textContent = "No plant yet: create one over the API, upload a survey and map it.";
    return;
  }
  const asked = found.find((plant) => plant.id === address.get("plant")) ?? found[0];
  if (!asked) return;
  plants.value = asked.id;
  const version = Number(address.get("model"));
  await openPlant(asked.id, version > 0 ? version : undefined, address.get("module") ?? undefined);
}

/** Shows a plant: the version asked for, else the newest. */
async function openPlant(plant: string, version?: number, module?: string): Promise<void> {
  loading.abort();
  loading = new AbortController();
  const { signal } = loading;
  if (plant !== shown.plant) {
    // Nothing of the previous plant may be shown under the name of this one.
    models.replaceChildren();
    await present(undefined, [], [], []);
    shown.plant = plant;
  }
  status.textContent = "Loading …";
  const [found] = await Promise.all([listModels(plant, signal), surveys.show(plant)]);
  const name = (model: { version: number; created: string }) => `${model.version}, ${moment(model.created)}`;
  models.replaceChildren(...found.map((model) => h("option", { value: String(model.version) }, name(model))));
  models.disabled = found.length === 0;
  const newest = found[0]?.version;
  if (newest === undefined) {
    await present(undefined, [], [], []);
    status.textContent = "This plant has no model yet.";
    return;
  }
  const asked = found.some((model) => model.version === version) ? version : newest;
  models.value = String(asked);
  await openModel(plant, asked ?? newest, module);
}

async function openModel(plant: string, version: number, module?: string): Promise<void> {
  loading.abort();
  loading = new AbortController();
  const { signal } = loading;
  status.textContent = "Loading …";
  const model = await getModel(plant, version, signal);
  const get = async <P>(name: string, progress?: (features: number) => void): Promise<Feature<P>[]> => {
    const layer = model.layers.find((layer) => layer.layer === name);
    return layer ? getLayer<P>(layer, signal, progress) : [];
  };
  const total = model.layers.find((layer) => layer.layer === "modules")?.features ?? 0;
  const [benches, lines, modules] = await Promise.all([
    get<GroupProperties>("benches"),
    get<GroupProperties>("lines"),
    get<ModuleProperties>("modules", (count) => {
      if (count < total) status.textContent = `Loading: ${count.toLocaleString()} of ${plural(total, "module")}`;
    }),
  ]);
  if (signal.aborted) return;
  await present(model, modules, benches, lines);
  status.textContent = [
    plural(modules.length, "module"),
    plural(benches.length, "bench", "benches"),
    plural(lines.length, "line"),
  ].join(", ");
  if (module) select(module);
}

async function present(
  model: ModelDetail | undefined,
  modules: Feature<ModuleProperties>[],
  benches: Feature<GroupProperties>[],
  lines: Feature<GroupProperties>[],
): Promise<void> {
  shown.modules = modules;
  shown.moduleOfId = new Map(modules.map((module) => [module.id, module]));
  shown.nameOfId = new Map([...benches, ...lines].map((group) => [group.id, group.properties.label]));
  const download = byId<HTMLAnchorElement>("download");
  download.hidden = !model;
  download.href = model?.layers.find((layer) => layer.layer === "modules")?.href ?? "";
  download.download = `${plants.selectedOptions[0]?.text ?? "plant"}-${model?.version}.geojson`;
  search.disabled = modules.length === 0;
  select(undefined);
  find();
  showLegend();
  showWarnings(model);
  await map?.show({ modules, benches, lines });
}

function showWarnings(model: ModelDetail | undefined): void {
  const warnings = model?.warnings ?? [];
  byId("warnings-title").textContent = warnings.length > 0 ? `Warnings (${warnings.length})` : "Warnings";
  const item = (warning: ModelDetail["warnings"][number]) =>
    h(
      "li",
      {},
      h("p", {}, h("code", {}, warning.code), ` ${warning.message}`),
      ...(warning.images.length > 0 ? [h("p", { class: "quiet" }, warning.images.join(", "))] : []),
    );
  byId("warnings").replaceChildren(
    warnings.length > 0 ? h("ul", { class: "warnings" }, ...warnings.map(item)) : h("p", { class: "quiet" }, "None."),
  );
}

function showLegend(): void {
  const entries = legend(shown.colorBy, shown.modules);
  const item = ({ color, text }: { color: string; text: string }) => {
    const swatch = h("span", { class: "swatch" });
    swatch.style.backgroundColor = color;
    return h("li", {}, swatch, text);
  };
  const plain = shown.colorBy === "bench" ? [h("li", { class: "quiet" }, "Neighbouring benches differ.")] : [];
  byId("legend").replaceChildren(...entries.map(item), ...plain);
}

/** Lists the modules whose label holds, or whose identifier begins with, what was typed. */
function find(): void {
  const text = search.value.trim().toLowerCase();
  const said = byId("found");
  if (!text) {
    said.textContent = "";
    byId("results").replaceChildren();
    return;
  }
  const hits = shown.modules.filter(
    ({ id, properties }) => properties.label.toLowerCase().includes(text) || id.toLowerCase().startsWith(text),
  );
  const more = hits.length > MAX_RESULTS ? `, the first ${MAX_RESULTS} shown` : "";
  said.textContent =
    hits.length > 0 ? `${plural(hits.length, "module")}${more}` : "No module has such a label or identifier.";
  byId("results").replaceChildren(
    ...hits
      .slice(0, MAX_RESULTS)
      .map(({ id, properties }) =>
        h("li", {}, h("button", { type: "button", class: "plain", click: () => select(id) }, properties.label)),
      ),
  );
}

function select(id: string | undefined): void {
  const module = id === undefined ? undefined : shown.moduleOfId.get(id);
  shown.selected = module?.id;
  const place = byId("module");
  place.hidden = !module;
  place.replaceChildren(
    ...(module
      ? moduleDetails(
          module,
          (group) => shown.nameOfId.get(group),
          () => select(undefined),
        )
      : []),
  );
  void map?.select(module);
  remember();
}

plants.addEventListener("change", () => void attempt(() => openPlant(plants.value)));
models.addEventListener("change", () => void attempt(() => openModel(plants.value, Number(models.value))));
search.addEventListener("input", find);
search.addEventListener("keydown", (event) => {
  if (event.key === "Enter") byId("results").querySelector("button")?.click();
});
byId("colors").addEventListener("change", (event) => {
  shown.colorBy = (event.target as HTMLInputElement).value as ColorBy;
  showLegend();
  void map?.colorBy(shown.colorBy);
});
window.addEventListener("keydown", (event) => {
  if (event.key === "Escape") select(undefined);
});

void attempt(start);
