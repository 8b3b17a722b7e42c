// Bundles each page's script and style, and copies its HTML, into `dist`: the same bytes on every
// machine.
// Usage: npm ci && npm run build   (or `make web`); `--out DIR` writes elsewhere.
import { build } from "esbuild";
import { copyFile, mkdir, readdir, readFile, writeFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import path from "node:path";

const here = path.dirname(fileURLToPath(import.meta.url));
const flag = process.argv.indexOf("--out");
const out = flag < 0 ? path.join(here, "dist") : path.resolve(process.argv[flag + 1]);

await mkdir(out, { recursive: true });
for (const [page, entry] of [
  ["report", "main.js"],
  ["annotate", "main.js"],
]) {
  for (const name of await readdir(path.join(here, page))) {
    if (name.endsWith(".html")) await copyFile(path.join(here, page, name), path.join(out, name));
  }
  await build({
    absWorkingDir: here,
    entryPoints: { [page]: `${page}/${entry}` },
    outdir: out,
    bundle: true,
    minify: true,
    format: "iife",
    target: "es2022",
    charset: "utf8",
    legalComments: "none",
    logLevel: "warning",
  });
}

// The licences of what is inside the bundles travel with them.
const notices = [];
for (const name of ["plotly.js-basic-dist-min", "three"]) {
  const folder = path.join(here, "node_modules", name);
  const { version } = JSON.parse(await readFile(path.join(folder, "package.json"), "utf8"));
  const license = await readFile(path.join(folder, "LICENSE"), "utf8");
  notices.push(`${name} ${version}\n\n${license.trim()}\n`);
}
await writeFile(path.join(out, "LICENSES.txt"), notices.join("\n---\n\n"));
