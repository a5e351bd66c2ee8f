import { defineConfig } from "vite";

export default defineConfig({
  base: "./",
  build: { target: "es2022", chunkSizeWarningLimit: 1500 },
  // `npm run dev` shows the plants of a service that runs beside it.
  server: { proxy: { "/api": "http://127.0.0.1:8080", "/openapi.yaml": "http://127.0.0.1:8080" } },
});
