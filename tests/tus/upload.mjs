// Uploads a file with tus-js-client: node upload.mjs ENDPOINT FILE PLACE. Prints where the upload is.

import { createReadStream, statSync } from "node:fs";
import { Upload } from "tus-js-client";

const [endpoint, file, place] = process.argv.slice(2);
const upload = new Upload(createReadStream(file), {
  endpoint,
  chunkSize: 64 * 1024 * 1024,
  uploadSize: statSync(file).size,
  retryDelays: Array(10).fill(100),
  metadata: { path: place },
  onError(error) {
    console.error(String(error));
    process.exit(1);
  },
  onSuccess() {
    console.log(upload.url);
  },
});
upload.start();
