import { render } from "preact";
import { App } from "./app.tsx";
import "./style/base.css";
import "./style/screens.css";
import "./style/result.css";

const root = document.getElementById("page");
if (root !== null) render(<App />, root);
