// One strip per sequence with a tick for every frame. Chosen frames fill the height, tracked ones the middle,
// candidates that were not chosen the lower edge.

function makeTimeline(onPick) {
  const box = document.getElementById("timeline");
  if (!box) return {draw() {}, pick() {}};
  const colors = {registered: "--mapping", chosen: "--tracked", failed: "--failed", skipped: "--skipped", unreadable: "--unreadable"};
  const key = element("div", {class: "key"});
  for (const status of Object.keys(colors)) {
    const n = rows.filter(i => frames.status(i) === status).length;
    if (!n) continue;
    key.append(element("span", {}, element("i", {style: `background:var(${colors[status]})`}), `${status} (${n.toLocaleString("en")})`));
    if (status === "registered" && frames.evaluation.some(v => v))
      key.append(element("span", {}, element("i", {style: "background:var(--evaluation)"}), "registered, evaluation"));
  }
  box.append(key);
  const tip = element("div", {id: "tip"});
  const lanes = [];
  for (const name of [...new Set(rows.map(i => frames.sequence(i)))]) {
    const mine = rows.filter(i => frames.sequence(i) === name);
    const last = mine.reduce((most, i) => Math.max(most, frames.time_s[i]), 0);
    const canvas = element("canvas");
    const kind = frames.evaluation[mine[0]] ? "evaluation" : "mapping";
    const lane = element("div", {class: "lane"}, element("b", {}, name), " ",
      element("small", {}, `${kind}, ${last < 120 ? last.toFixed(0) + " s" : (last / 60).toFixed(1) + " min"}`), canvas);
    box.append(lane);
    lanes.push({canvas, mine, last: last || 1, lane});
    const x = i => 4 + frames.time_s[i] / (last || 1) * (canvas.clientWidth - 8);
    // Nearest frame; frames with an attempted pose are preferred to other candidates.
    const find = px => {
      let best = -1, least = 12;
      for (const i of mine) {
        const far = Math.abs(x(i) - px) + (tried(i) ? 0 : 2) + (frames.tracked[i] ? 1 : 0);
        if (far < least) { least = far; best = i; }
      }
      return best;
    };
    canvas.addEventListener("pointermove", event => {
      const i = find(event.offsetX);
      tip.textContent = i < 0 ? "" : `${frames.name(i)} at ${frames.time_s[i].toFixed(1)} s: ${frames.reason(i) || frames.status(i)}`;
      if (i < 0) return;
      lane.append(tip);
      tip.style.left = `${Math.max(0, Math.min(x(i), canvas.clientWidth - 280))}px`;
      tip.style.top = "100%";
    });
    canvas.addEventListener("pointerleave", () => { tip.textContent = ""; });
    canvas.addEventListener("click", event => onPick(find(event.offsetX)));
  }
  let marked = -1;

  function draw() {
    const scale = window.devicePixelRatio || 1;
    for (const {canvas, mine, last} of lanes) {
      canvas.width = Math.round(canvas.clientWidth * scale);
      canvas.height = Math.round(canvas.clientHeight * scale);
      const context = canvas.getContext("2d"), h = canvas.height, w = canvas.width - 8 * scale;
      const weight = i => tried(i) ? (frames.status(i) === "failed" ? 2 : 1) : 0;
      for (const i of [...mine].sort((a, b) => weight(a) - weight(b))) {
        const status = frames.status(i);
        const color = status === "registered" && frames.evaluation[i] ? "--evaluation" : colors[status];
        const failed = status === "failed";
        const [top, height] = !tried(i) && status !== "chosen" ? [0.72, 0.28] : frames.tracked[i] ? [0.36, 0.3] : [0, failed ? 1 : 0.66];
        context.fillStyle = css(color);
        context.fillRect(4 * scale + frames.time_s[i] / last * w - scale / 2, top * h, Math.max(1, (failed ? 2.5 : 1.2) * scale), height * h);
      }
      if (mine.includes(marked)) {
        context.fillStyle = css("--picked");
        context.fillRect(4 * scale + frames.time_s[marked] / last * w - 1.5 * scale, 0, 3 * scale, h);
      }
    }
  }
  return {draw, pick(i) { marked = i; draw(); }};
}
