// Surveys of a plant, with the progress of their mappings.

import {
  cancelJob,
  getPhotoPositions,
  getSurvey,
  type Job,
  latestJob,
  listSurveys,
  listWarnedPhotos,
  type PhotoPosition,
  Problem,
  type Survey,
  startJob,
} from "./api";
import { h, moment, plural } from "./dom";

const POLL_MS = 1000;
const SLOWEST_POLL_MS = 15_000;
const STAGES: Record<string, string> = {
  read: "reading the reconstruction",
  detect: "finding modules in the photos",
  layout: "finding rows and benches",
  locate: "placing them in space",
  fuse: "merging the photos",
  refine: "refining positions",
  assemble: "naming modules",
};

const isFinal = (job: Job) => job.state !== "queued" && job.state !== "running";

/** The list of surveys. It asks for the state of unfinished jobs until they end. */
export class Surveys {
  private stop = new AbortController();

  /** `mapped` hears when a job has made a model, `located` where the photos of the survey that is looked at were taken. */
  constructor(
    private readonly place: HTMLElement,
    private readonly mapped: (plant: string, version: number) => void,
    private readonly located: (photos: PhotoPosition[]) => void,
  ) {}

  /** Shows the surveys of a plant, or none. */
  async show(plant: string | undefined): Promise<void> {
    this.stop.abort();
    const stop = new AbortController();
    this.stop = stop;
    this.place.replaceChildren();
    this.located([]);
    if (!plant) return;
    const surveys = await listSurveys(plant, stop.signal);
    if (stop.signal.aborted) return;
    if (surveys.length === 0) {
      this.place.replaceChildren(h("p", { class: "quiet" }, "No survey yet: upload photos and a reconstruction."));
      return;
    }
    surveys.reverse();
    this.place.replaceChildren(...surveys.map((survey) => this.entry(survey, stop.signal)));
  }

  private entry(survey: Survey, signal: AbortSignal): HTMLElement {
    const job = h("div", { class: "job" });
    const files = h("div", {});
    // One survey is open at a time: its photos are shown on the map.
    const details = h("details", { name: "survey-photos" }, h("summary", {}, "Photos and files"), files);
    details.addEventListener("toggle", () => {
      if (details.open) void this.describe(survey, files, () => details.open && !signal.aborted);
      else if (!this.place.querySelector("details[open]")) this.located([]);
    });
    void this.follow(survey, job, signal);
    return h("article", { class: "survey" }, h("h3", {}, survey.name), job, details);
  }

  /** Asks for the newest job until it has ended, shown in `place`. */
  private async follow(survey: Survey, place: HTMLElement, signal: AbortSignal): Promise<void> {
    let pause = POLL_MS;
    let seenUnfinished = false;
    const again = () => void this.follow(survey, place, signal);
    while (!signal.aborted) {
      try {
        const job = await latestJob(survey);
        if (signal.aborted) return;
        this.draw(survey, job, place, again);
        if (!job || isFinal(job)) {
          if (seenUnfinished && job?.model_version !== undefined) this.mapped(survey.plant, job.model_version);
          return;
        }
        seenUnfinished = true;
        pause = POLL_MS;
      } catch (error) {
        // The service may be unreachable for a moment; the last known state stays.
        pause = Math.min(SLOWEST_POLL_MS, pause * 2);
        place.querySelector(".trouble")?.remove();
        place.append(h("p", { class: "trouble" }, `${errorText(error)} Retrying in ${Math.round(pause / 1000)} s.`));
      }
      await new Promise((resolve) => setTimeout(resolve, pause));
    }
  }

  /** Says what a survey holds and what is wrong with its photos, and shows where they were taken. */
  private async describe(survey: Survey, place: HTMLElement, isOpen: () => boolean): Promise<void> {
    try {
      const [detail, warned, positions] = await Promise.all([
        getSurvey(survey),
        listWarnedPhotos(survey),
        getPhotoPositions(survey),
      ]);
      if (!isOpen()) return;
      const { files, missing, images } = detail;
      const megabytes = files.reduce((sum, file) => sum + file.size, 0) / 1e6;
      const left = images.not_reconstructed_count;
      place.replaceChildren(
        h(
          "p",
          { class: "quiet" },
          `${plural(images.uploaded, "photo")}, ${plural(files.length - images.uploaded, "file")} of the reconstruction, ` +
            `${megabytes.toFixed(1)} MB. ${plural(positions.length, "photo")} on the map.`,
        ),
        ...missing.map(({ message }) => h("p", { class: "trouble" }, message)),
        ...(left > 0 ? [h("p", {}, `${plural(left, "photo is", "photos are")} not in the reconstruction.`)] : []),
        h(
          "ul",
          { class: "images warned" },
          ...warned.map(({ name, warnings = [] }) =>
            h("li", {}, h("strong", {}, name), ` ${warnings.map(({ message }) => message).join("; ")}`),
          ),
        ),
      );
      this.located(positions);
    } catch (error) {
      place.replaceChildren(h("p", { class: "trouble" }, errorText(error)));
    }
  }

  private draw(survey: Survey, job: Job | undefined, place: HTMLElement, again: () => void): void {
    const act = (label: string, action: () => Promise<unknown>) =>
      h(
        "button",
        {
          type: "button",
          click: (event) => {
            const button = event.currentTarget as HTMLButtonElement;
            button.disabled = true;
            action().then(again, (error: unknown) => {
              button.disabled = false;
              place.querySelector(".trouble")?.remove();
              place.append(h("p", { class: "trouble", role: "alert" }, errorText(error)));
            });
          },
        },
        label,
      );
    if (!job) {
      place.replaceChildren(
        h("p", { class: "quiet" }, "Not mapped yet."),
        act("Map it", () => startJob(survey)),
      );
      return;
    }
    if (!isFinal(job)) {
      const { text, share } = standing(job);
      let bar = place.querySelector("progress");
      if (!bar) {
        bar = h("progress", { max: "1", "aria-label": `Mapping of ${survey.name}` });
        const cancel = act("Cancel", async () => {
          await cancelJob(survey, job);
        });
        cancel.className = "plain";
        place.replaceChildren(h("p", { class: "stage" }), bar, cancel);
      }
      if (share === undefined) bar.removeAttribute("value");
      else bar.value = share;
      place.querySelector(".trouble")?.remove();
      place.querySelector(".stage")?.replaceChildren(text);
      return;
    }
    const when = moment(job.finished ?? job.created);
    if (job.state === "succeeded") {
      const version = job.model_version ?? 0;
      const open = h("button", { type: "button", class: "plain", click: () => this.mapped(survey.plant, version) });
      open.textContent = `model ${version}`;
      place.replaceChildren(h("p", {}, "Mapped as ", open, ` on ${when}.`));
      return;
    }
    const failed = job.state === "failed";
    place.replaceChildren(
      h("p", { class: failed ? "trouble" : "quiet" }, `${failed ? "Failed" : "Cancelled"} on ${when}.`),
      ...(failed ? [h("p", {}, job.error?.message ?? "No reason given.")] : []),
      act("Map it again", () => startJob(survey)),
    );
  }
}

/** Where an unfinished job is, in words and as a share of the whole. */
function standing(job: Job): { text: string; share?: number } {
  if (job.cancel_requested) return { text: "Stopping …" };
  if (job.state === "queued") return { text: "Waiting for a worker …" };
  const progress = job.progress;
  if (!progress) return { text: "Starting …" };
  const part = progress.total > 0 ? Math.min(1, progress.done / progress.total) : 0;
  const stage = STAGES[progress.stage] ?? progress.stage;
  return {
    text: `Step ${progress.stage_number} of ${progress.stage_count}: ${stage} (${progress.done} of ${progress.total})`,
    share: (Math.max(0, progress.stage_number - 1) + part) / Math.max(1, progress.stage_count),
  };
}

export function errorText(error: unknown): string {
  return error instanceof Problem ? `${error.title}. ${error.detail}` : String(error);
}
