import "../common/theme.css";
import { Stage } from "../common/stage.js";

window.Stage = Stage;
