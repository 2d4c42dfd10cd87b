// Connects the parts: a frame picked in one is shown in all.
const root = document.documentElement;
root.classList.toggle("dark", matchMedia("(prefers-color-scheme: dark)").matches);

const parts = {};
function pickFrom(source) {
  return i => {
    parts.view.pick(i, source === "table");
    parts.timeline.pick(i);
    parts.table.pick(i, source !== "table");
    const box = document.getElementById("picked");
    box.textContent = "";
    if (i < 0) return;
    const lines = [[frames.name(i), `${frames.status(i)}${frames.reason(i) ? `: ${frames.reason(i)}` : ""}`]];
    lines[0].push(`${frames.time_s[i].toFixed(2)} s`);
    if (hasPose(i)) {
      lines[0].push(`${[0, 1, 2].map(k => figure(frames.center[3 * i + k], 2)).join(", ")} ${unit}`);
      if (Number.isFinite(frames.sigma_m[i])) lines[0].push(`sigma ${figure(frames.sigma_m[i], 3)} ${unit}`);
      lines[0].push(`${frames.inliers[i]} points, ${figure(frames.error_px[i], 2)} px`);
    }
    for (const line of lines[0]) box.append(element("div", {}, line));
  };
}
parts.table = makeTable(pickFrom("table"));
parts.timeline = makeTimeline(pickFrom("timeline"));
parts.view = makeView(pickFrom("view"));
parts.timeline.draw();
new ResizeObserver(() => parts.timeline.draw()).observe(document.querySelector("main"));
document.getElementById("theme").onclick = () => {
  root.classList.toggle("dark");
  parts.view.redraw();
  parts.timeline.draw();
};
window.spnReport = parts;  // for debugging in the console
root.dataset.drawn = parts.view.kind;
root.dataset.milliseconds = Math.round(performance.now());
