// Table of all frames, sorted and filtered; only visible rows are in the document.

function makeTable(onPick) {
  const box = document.getElementById("table");
  const ROW = 26;
  const kind = i => (frames.evaluation[i] ? "evaluation" : "mapping") + (frames.tracked[i] ? ", tracked" : "");
  const horizontal = i => Math.hypot(frames.gnss_m[3 * i], frames.gnss_m[3 * i + 1]);
  const number = (label, title, width, value, digits) => ({label, title, width, value, digits, number: true});
  const text = (label, title, width, value) => ({label, title, width, value});
  const axes = report.units === "m" ? ["east", "north", "up"] : ["x", "y", "z"];
  const columns = [
    text("frame", "image name", 175, frames.name),
    text("sequence", "", 90, frames.sequence),
    text("kind", "mapping or evaluation; tracked frames are not among the chosen ones", 130, kind),
    number("time, s", "since the first frame of the sequence", 85, i => frames.time_s[i], 2),
    text("status", "", 85, frames.status),
    ...axes.map((axis, k) => number(`${axis}, ${unit}`, "camera centre", 90, i => frames.center[3 * i + k], 3)),
    number(`sigma, ${unit}`, "position uncertainty, 1 sigma", 95, i => frames.sigma_m[i], 3),
    number("sigma, deg", "rotation uncertainty, 1 sigma", 110, i => frames.sigma_deg[i], 3),
    number("inliers", "map points that support the pose", 85, i => frames.inliers[i] || NaN, 0),
    number("error, px", "RMS reprojection error", 100, i => frames.error_px[i], 2),
    number("GNSS h, m", "horizontal distance between GNSS fix and pose", 110, horizontal, 2),
    number("GNSS v, m", "height of the GNSS fix above the pose", 110, i => frames.gnss_m[3 * i + 2], 2),
    ...(estimates.length ? [number(`estimate off, ${unit}`, "position error of the estimates chosen in the map", 120, i => estimateError("error", i), 2),
      number("estimate off, deg", "rotation error of the estimates chosen in the map", 130, i => estimateError("error_deg", i), 2)] : []),
    text("coverage", "coverage stratum", 85, frames.stratum),
    text("split", "group of the split", 100, frames.group),
    text("reason", "why the frame has no pose or was not chosen", 260, frames.reason),
  ].filter(column => rows.some(i => column.number ? Number.isFinite(column.value(i)) : column.value(i) !== ""));

  const search = element("input", {type: "search", placeholder: "Search names and reasons", "aria-label": "Search"});
  const choice = (label, values) => {
    const select = element("select", {"aria-label": label}, element("option", {value: ""}, `${label}: all`));
    for (const value of [...new Set(values)].sort()) select.append(element("option", {value}, value));
    return select;
  };
  const bySequence = choice("sequence", rows.map(frames.sequence));
  const byStatus = choice("status", rows.map(frames.status));
  const byKind = choice("kind", rows.map(kind));
  const count = element("span", {class: "note"});
  const body = element("tbody"), head = element("tr"), frame = element("div", {class: "rows", tabindex: "0"});
  const width = columns.reduce((sum, column) => sum + column.width, 0);
  const table = element("table", {style: `width:max(100%, ${width}px)`}, element("thead", {}, head), body);
  const heads = columns.map((column, k) => {
    const button = element("button", {type: "button", title: column.title}, column.label);
    button.onclick = () => sortBy(k);
    const cell = element("th", {style: `width:${column.width}px`, class: column.number ? "number" : "", scope: "col"}, button);
    head.append(cell);
    return cell;
  });
  frame.append(table);
  box.append(element("div", {class: "filters"}, search, bySequence, byStatus, byKind, count), frame);
  if (rows.some(tried)) byStatus.prepend(element("option", {value: "tried"}, "status: pose attempted"));
  byStatus.value = rows.some(tried) ? "tried" : "";

  let order = -1, direction = 1, listed = rows, marked = -1;

  function sortBy(k) {
    direction = order === k ? -direction : 1;
    order = k;
    heads.forEach((cell, j) => j === k
      ? cell.setAttribute("aria-sort", direction > 0 ? "ascending" : "descending") : cell.removeAttribute("aria-sort"));
    update();
  }

  function update() {
    const words = search.value.toLowerCase();
    listed = rows.filter(i => (!bySequence.value || frames.sequence(i) === bySequence.value)
      && (byStatus.value === "tried" ? tried(i) : !byStatus.value || frames.status(i) === byStatus.value)
      && (!byKind.value || kind(i) === byKind.value)
      && (!words || frames.name(i).toLowerCase().includes(words) || frames.reason(i).toLowerCase().includes(words)));
    if (order >= 0) {
      const column = columns[order], value = column.value;
      // Unknown values come last in both sort directions.
      listed.sort(column.number
        ? (a, b) => {
          const [p, q] = [value(a), value(b)], [np, nq] = [Number.isNaN(p), Number.isNaN(q)];
          return np || nq ? np - nq : direction * (p - q);
        }
        : (a, b) => direction * (value(a) < value(b) ? -1 : value(a) > value(b) ? 1 : 0));
    }
    count.textContent = `${listed.length.toLocaleString("en")} of ${rows.length.toLocaleString("en")} frames`;
    frame.scrollTop = 0;
    fill();
  }

  function fill() {
    const first = Math.max(0, Math.floor(frame.scrollTop / ROW) - 10);
    const last = Math.min(listed.length, first + Math.ceil((frame.clientHeight || 500) / ROW) + 20);
    const spacer = n => element("tr", {style: `height:${n * ROW}px`});
    const made = [];
    if (first) made.push(spacer(first));
    for (const i of listed.slice(first, last)) {
      const row = element("tr", {class: `${frames.status(i)}${i === marked ? " picked" : ""}`, "data-row": i});
      for (const column of columns) {
        const value = column.number ? figure(column.value(i), column.digits) : column.value(i);
        row.append(element("td", column.number ? {class: "number"} : {title: value}, value));
      }
      made.push(row);
    }
    if (last < listed.length) made.push(spacer(listed.length - last));
    body.replaceChildren(...made);
  }

  let waiting = false;
  frame.addEventListener("scroll", () => {
    if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; fill(); }); }
  });
  body.addEventListener("click", event => {
    const row = event.target.closest("tr[data-row]");
    if (row) onPick(Number(row.dataset.row));
  });
  for (const part of [search, bySequence, byStatus, byKind]) part.addEventListener("input", update);
  update();
  return {
    update,
    pick(i, scroll) {
      marked = i;
      const at = listed.indexOf(i);
      if (scroll && at >= 0) frame.scrollTop = Math.max(0, at * ROW - frame.clientHeight / 2);
      fill();
    },
  };
}
