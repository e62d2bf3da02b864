import { render } from "preact";
import { takeKeyFromAddress } from "./api/key.ts";
import { App } from "./app.tsx";
import { currentRoute } from "./route.ts";
import "./style/base.css";
import "./style/screens.css";
import "./style/remedies.css";
import "./style/result.css";

takeKeyFromAddress();
const { path } = currentRoute();
if (path[0] === "fits" && path.length > 1) void import("./result/result.tsx"); // it will be needed

const root = document.getElementById("page");
if (root !== null) render(<App />, root);
