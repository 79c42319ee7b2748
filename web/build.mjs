// Bundle the viewer to services/page/static/viewer/: viewer.js, one ES module, and licences.txt of the packages in it.
import { mkdirSync, readFileSync, readdirSync, renameSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const folder = process.argv[2] ?? join(here, "../services/page/static/viewer");

const result = await build({
  absWorkingDir: here,
  entryPoints: ["src/viewer.js"],
  bundle: true,
  minify: true,
  write: false,
  metafile: true,
  outfile: "viewer.js",
  format: "esm",
  target: "es2022",
  charset: "utf8",
  legalComments: "inline", // the copyright goes where the bundle goes, into reports too
  loader: { ".css": "text", ".glsl": "text" },
});

/** Return the folders of the packages whose files are in the bundle. */
function packages() {
  const found = Object.keys(result.metafile.inputs).map((path) => path.match(/^(.*node_modules\/(?:@[^/]+\/)?[^/]+)\//)?.[1]);
  return [...new Set(found)].filter((path) => path !== undefined).map((path) => join(here, path)).sort();
}

const licences = packages().map((path) => {
  const { name, version, license } = JSON.parse(readFileSync(join(path, "package.json"), "utf8"));
  const file = readdirSync(path).find((f) => /^licen[cs]e/i.test(f));
  if (!file) throw new Error(`${name}: has no licence file, so it cannot be distributed`);
  return `${name} ${version} (${license})\n\n${readFileSync(join(path, file), "utf8").trim()}\n`;
});

mkdirSync(folder, { recursive: true });
const files = { "licences.txt": licences.join("\n---\n\n"), "viewer.js": result.outputFiles[0].text };
for (const [name, text] of Object.entries(files)) {
  const temporary = join(folder, `.${name}.part`); // a page that starts meanwhile reads the whole file, old or new
  writeFileSync(temporary, text);
  renameSync(temporary, join(folder, name));
}
console.log(`3D viewer: ${(files["viewer.js"].length / 1e3).toFixed(0)} kB in ${join(folder, "viewer.js")}`);
