// The image of a picked frame, with what is known of it, wherever on the page it was picked.
const imageOf = i => report.images[i] === undefined ? null : `data:image/jpeg;base64,${report.images[i]}`;

// Nearest frame in time, of the same sequence, that has an image.
function nearestImage(i) {
  let best = -1, least = Infinity;
  for (let k = 0; k < frames.count; k++) {
    if (report.images[k] === undefined || frames.sequence(k) !== frames.sequence(i)) continue;
    const far = Math.abs(frames.time_s[k] - frames.time_s[i]);
    if (far < least) { least = far; best = k; }
  }
  return best;
}

function makeFrame(onPick) {
  const box = document.getElementById("picked");
  const button = (text, title, act) => {
    const made = element("button", {type: "button", title, "aria-label": title}, text);
    made.onclick = act;
    return made;
  };

  function picture(i) {
    const k = imageOf(i) ? i : nearestImage(i);
    if (k < 0) return [element("div", {class: "note"}, "No image of this sequence is on this page.")];
    const image = element("img", {src: imageOf(k), alt: frames.name(k)});
    const path = report.files[k];
    const shown = path === undefined ? image : element("a", {target: "_blank", title: "Open the full image, where this page lies in its area",
      href: `./${path.split("/").map(encodeURIComponent).join("/")}`}, image);
    if (k === i) return [shown];
    const apart = frames.time_s[k] - frames.time_s[i];
    const words = `No image of this frame is on this page: ${frames.name(k)}, ${Math.abs(apart).toFixed(2)} s ${apart < 0 ? "earlier" : "later"}.`;
    return [shown, element("div", {class: "warn"}, words)];
  }

  function facts(i) {
    const lines = [`${frames.status(i)}${frames.reason(i) ? `: ${frames.reason(i)}` : ""}`, `at ${frames.time_s[i].toFixed(2)} s`];
    if (hasPose(i)) {
      lines.push(`${[0, 1, 2].map(k => figure(frames.center[3 * i + k], 2)).join(", ")} ${unit}`);
      if (Number.isFinite(frames.sigma_m[i])) lines.push(`sigma ${figure(frames.sigma_m[i], 3)} ${unit}`);
      lines.push(`${frames.inliers[i]} points, ${figure(frames.error_px[i], 2)} px`);
    }
    return [...lines, ...estimateLines(i)].map(line => element("div", {}, line));
  }

  addEventListener("keydown", event => { if (event.key === "Escape") onPick(-1); });
  const find = new Map(rows.map(i => [frames.name(i), i]));
  for (const part of document.querySelectorAll("[data-frame]")) {
    const i = find.get(part.dataset.frame);
    const image = part.querySelector("img");
    if (image && i !== undefined && imageOf(i)) image.src = imageOf(i);
    else if (image) image.replaceWith(element("div", {class: "note"}, "no image"));
    if (i === undefined) continue;
    part.addEventListener("click", () => onPick(i));
    part.addEventListener("keydown", event => { if (event.key === "Enter") onPick(i); });
  }
  return {
    pick(i) {
      box.hidden = i < 0;
      if (i < 0) { box.replaceChildren(); return; }
      const step = d => rows.includes(i + d) ? onPick(i + d) : undefined;
      box.replaceChildren(
        element("div", {class: "bar-of-frame"}, element("b", {}, frames.name(i)), button("\u2039", "Previous frame", () => step(-1)),
          button("\u203a", "Next frame", () => step(1)), button("\u00d7", "Close", () => onPick(-1))),
        ...picture(i), ...facts(i));
    },
  };
}
