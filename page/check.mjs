// Types and the linter's rules, of one program: to read all types takes as long as to check them.
import { ESLint } from "eslint";
import ts from "typescript";

const faults = [];
const host = { ...ts.sys, onUnRecoverableConfigFileDiagnostic: (fault) => faults.push(fault) };
const { fileNames, options, errors } = ts.getParsedCommandLineOfConfigFile("tsconfig.json", {}, host);
const program = ts.createProgram(fileNames, options);
faults.push(...errors, ...ts.getPreEmitDiagnostics(program));
const names = { getCanonicalFileName: (name) => name, getCurrentDirectory: process.cwd, getNewLine: () => "\n" };
process.stderr.write(ts.formatDiagnostics(faults, names));

const parserOptions = { projectService: false, programs: [program] };
const eslint = new ESLint({ overrideConfig: { languageOptions: { parserOptions } } });
const found = await eslint.lintFiles(".");
process.stderr.write(await (await eslint.loadFormatter()).format(found));
process.exitCode = faults.length || found.some((file) => file.errorCount) ? 1 : 0;
