// Opens the built page in Chromium and uses it. CHROMIUM names the browser, SHOTS a folder for screenshots, and PAGE a
// running service with a mapped plant to use instead of the fake one.

import assert from "node:assert/strict";
import { mkdir } from "node:fs/promises";
import { join } from "node:path";
import { chromium } from "playwright-core";
import { serve } from "./fixture.mjs";

const shots = process.env.SHOTS;
if (shots) await mkdir(shots, { recursive: true });
const fixture = process.env.PAGE ? undefined : await serve();
const address = process.env.PAGE ?? fixture.url;
const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
});

try {
  const page = await browser.newPage({ viewport: { width: 1280, height: 800 } });
  const foreignRequests = [];
  const errors = [];
  page.on("request", (request) => {
    if (!request.url().startsWith(address) && !/^(data|blob):/.test(request.url())) foreignRequests.push(request.url());
  });
  page.on("pageerror", (error) => errors.push(String(error)));
  page.on("console", (message) => message.type() === "error" && errors.push(message.text()));
  const shot = async (name) => {
    if (shots) await page.screenshot({ path: join(shots, `${name}.png`) });
  };
  const settled = async () => {
    await page.waitForTimeout(500);
    await page.locator('#map[data-drawn="all"]').waitFor();
  };
  const status = page.locator("#status");

  await page.goto(address);
  await status.filter({ hasText: /^[\d,.]+ modules?, / }).waitFor();
  await settled();
  await shot("plant");

  const search = page.locator("#search");
  await search.fill("L01-B01-R1");
  const first = page.locator("#results button").first();
  const label = await first.textContent();
  await first.click();
  await page.locator("#module-title").filter({ hasText: label }).waitFor();
  await settled();
  await shot("module");
  assert.match(page.url(), /module=[0-9a-f-]{36}/);

  // The link leads back to the same module.
  const link = page.url();
  await page.goto("about:blank");
  await page.goto(link);
  await page.locator("#module-title").filter({ hasText: label }).waitFor();
  await search.fill("no such module");
  await page.locator("#found").filter({ hasText: "No module has such a label" }).waitFor();
  await search.fill("");

  // A click on the map selects a module, and the search finds it by its label.
  await page.keyboard.press("Escape");
  const details = page.locator("#module");
  await details.waitFor({ state: "hidden" });
  await settled();
  const box = await page.locator("#map").boundingBox();
  for (let step = 0; step < 400 && !(await details.isVisible()); step++) {
    const [x, y] = [(step % 20) + 0.5, Math.floor(step / 20) + 0.5];
    await page.mouse.click(box.x + (box.width * x) / 20, box.y + (box.height * y) / 20);
  }
  const clicked = await page.locator("#module-title").textContent();
  await search.fill(clicked);
  await page.locator("#results button").filter({ hasText: clicked }).waitFor();
  await search.fill("");

  await page.getByLabel("status").check();
  await page.locator("#legend").filter({ hasText: "detected" }).waitFor();
  await page.getByLabel("row", { exact: true }).check();
  await page.locator("#legend").filter({ hasText: "the northern" }).waitFor();
  await settled();
  await shot("rows");

  if (fixture) {
    assert.deepEqual(errors, []);
    await page.locator("#warnings").filter({ hasText: "unmatched_bench" }).waitFor();
    await page.locator(".survey").filter({ hasText: "is cut short" }).waitFor();
    const failed = page.locator(".survey").filter({ hasText: "2026-06-20 noon" });
    await failed.getByRole("button", { name: "Map it again" }).click();
    await failed
      .locator(".stage")
      .filter({ hasText: /Step [2-6] of 7/ })
      .waitFor();
    assert.ok((await failed.locator("progress").evaluate((bar) => bar.position)) > 0.1);
    await failed.scrollIntoViewIfNeeded();
    await shot("progress");
    await failed.filter({ hasText: "Mapped as model 3" }).waitFor();
    // The new model opens when the job ends.
    await page
      .locator("#models")
      .locator("option:checked")
      .filter({ hasText: /^3, / })
      .waitFor({ state: "attached", timeout: 30_000 });

    await page.locator("#plants").selectOption({ label: "Sunfield South" });
    await status.filter({ hasText: "150 benches, 30 lines" }).waitFor();
    await page.getByLabel("bench", { exact: true }).check();
    await settled();
    await shot("large");

    await page.locator("#plants").selectOption({ label: "Not yet mapped" });
    await status.filter({ hasText: "no model yet" }).waitFor();
    await page.locator("#plants").selectOption({ label: "Out of order" });
    await page.locator("#problem").filter({ hasText: "internal_error" }).waitFor();
    await shot("problem");
    await page.locator("#plants").selectOption({ label: "Sunfield North" });
    await status.filter({ hasText: "4 lines" }).waitFor();
    await page.locator("#problem").waitFor({ state: "hidden" });

    await page.setViewportSize({ width: 420, height: 800 });
    await settled();
    await shot("narrow");
  } else {
    assert.deepEqual(errors, []);
  }
  assert.deepEqual(foreignRequests, [], "the page asked other hosts");
  console.log("the page works");
} finally {
  await browser.close();
  fixture?.close();
}
