// Connects the parts: a frame picked in one is shown in all.
const root = document.documentElement;
root.classList.toggle("dark", matchMedia("(prefers-color-scheme: dark)").matches);

const parts = {};
function pickFrom(source) {
  return i => {
    parts.view.pick(i, source !== "view");
    parts.timeline.pick(i);
    parts.table.pick(i, source !== "table");
    parts.frame.pick(i);
  };
}
parts.table = makeTable(pickFrom("table"));
parts.timeline = makeTimeline(pickFrom("timeline"));
parts.view = makeView(pickFrom("view"), () => parts.table.update());
parts.frame = makeFrame(pickFrom("frame"));
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
