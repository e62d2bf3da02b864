// Serves the page from its sources, made anew at each change, and hands everything else to a running service:
// `npm run dev`. FEWVIEW_URL is the service's address, PORT where the page is.
import { createReadStream } from "node:fs";
import { readFile } from "node:fs/promises";
import { createServer, request as plain } from "node:http";
import { request as secure } from "node:https";
import { context } from "esbuild";
import { BUNDLE } from "./bundle.mjs";

const HOST = "127.0.0.1";
const service = new URL(process.env.FEWVIEW_URL ?? "http://127.0.0.1:8000");
const port = Number(process.env.PORT ?? 8080);
const names = [`${HOST}:${port}`, `localhost:${port}`];
const ask = service.protocol === "https:" ? secure : plain;
const RELOAD = '<script>new EventSource("page/esbuild").addEventListener("change", () => location.reload())</script>';

const making = await context({ ...BUNDLE, outdir: "page", write: false, sourcemap: "linked" });
await making.watch();
const made = await making.serve({ host: HOST, port: 0 });

// Another name may be a foreign page's, whose host was pointed at this machine.
const isOurs = (request) => names.includes(request.headers.host ?? "");

/** What the service is asked: as if its own page asked it, and no other. */
function options({ method, url, headers }) {
  const own = names.some((name) => headers.origin === `http://${name}`);
  const path = service.pathname.replace(/\/$/, "") + url;
  const sent = { ...headers, host: service.host, ...(own && { origin: service.origin }) };
  return { hostname: service.hostname, port: service.port, method, path, headers: sent };
}

/** Sends a request on, and its answer back as it comes: event streams, too. */
function pass(request, answer, to, send) {
  const onward = send(to, (came) => {
    answer.writeHead(came.statusCode, came.headers);
    came.pipe(answer);
  });
  onward.on("error", (error) => {
    if (!answer.headersSent) answer.writeHead(502, { "Content-Type": "text/plain" });
    answer.end(`${service.href} does not answer (${error.code}): start it with \`fewview serve\`.`);
  });
  answer.on("close", () => onward.destroy());
  request.pipe(onward);
}

async function sendIndex(answer) {
  const text = (await readFile("index.html", "utf8"))
    .replace("SCRIPT", "main.js")
    .replace("STYLE", "main.css")
    .replace("ICON", "icon.svg")
    .replace("PRELOADS", RELOAD);
  answer.writeHead(200, { "Content-Type": "text/html; charset=utf-8", "Cache-Control": "no-store" }).end(text);
}

const server = createServer((request, answer) => {
  const { pathname } = new URL(request.url, `http://${HOST}`);
  if (!isOurs(request)) return answer.writeHead(421).end();
  if (pathname === "/") return void sendIndex(answer);
  if (pathname === "/page/icon.svg") {
    answer.writeHead(200, { "Content-Type": "image/svg+xml" });
    return void createReadStream("icon.svg").pipe(answer);
  }
  if (!pathname.startsWith("/page/")) return pass(request, answer, options(request), ask);
  const path = pathname.replace("/page/esbuild", "/esbuild").replace(/^\/page\//, "/");
  pass(request, answer, { host: HOST, port: made.port, path, headers: { accept: request.headers.accept } }, plain);
});

// A WebSocket: the service's answer to the handshake, then bytes both ways.
server.on("upgrade", (request, socket, head) => {
  if (!isOurs(request)) return socket.destroy();
  const onward = ask(options(request));
  onward.on("upgrade", (came, other, first) => {
    const lines = [`HTTP/1.1 101 ${came.statusMessage}`];
    for (let at = 0; at < came.rawHeaders.length; at += 2) lines.push(came.rawHeaders.slice(at, at + 2).join(": "));
    socket.write(`${lines.join("\r\n")}\r\n\r\n`);
    if (first.length > 0) socket.write(first);
    if (head.length > 0) other.write(head);
    other.pipe(socket).on("error", () => other.destroy());
    socket.pipe(other).on("error", () => socket.destroy());
  });
  onward.on("response", (came) => {
    socket.write(`HTTP/1.1 ${came.statusCode} ${came.statusMessage}\r\nConnection: close\r\n\r\n`);
    came.pipe(socket);
  });
  onward.on("error", () => socket.destroy());
  onward.end();
});

server.listen(port, HOST, () => console.log(`The page: http://${HOST}:${port}, of the service ${service.href}`));
