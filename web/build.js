// Bundles src/ with three.js and uPlot into ../src/sylpose/report/assets: report.js, report.css, and NOTICE with the licences
// of what is in them. The first line of the script says which sources it is of, which tests/report/test_page.py compares.

import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const OUT = "../src/sylpose/report/assets";
const read = (path) => readFileSync(path, "utf8").replaceAll("\r\n", "\n");

const digest = createHash("sha256");
for (const name of ["package-lock.json", ...readdirSync("src").sort().map((name) => `src/${name}`)]) {
  digest.update(`${name}\n${read(name)}`);
}

const parts = ["three", "uplot"].map((name) => {
  const { version, homepage, repository } = JSON.parse(read(`node_modules/${name}/package.json`));
  const at = homepage ?? repository.url;
  return `${name} ${version}, ${at}\n\n${read(`node_modules/${name}/LICENSE`).trim()}\n`;
});
const notice = `report.js and report.css contain:\n\n${parts.join("\n----\n\n")}`;
writeFileSync(`${OUT}/NOTICE`, notice);

await build({
  entryPoints: { report: "src/main.js" },
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2021",
  charset: "ascii",
  legalComments: "none",
  banner: { js: `/* sources ${digest.digest("hex")}\n\n${notice}*/`, css: `/*\n${notice}*/` },
  outdir: OUT,
});
