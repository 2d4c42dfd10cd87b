// Estimated poses of each run, and which of them are shown.
const WAYS = {coarse: "network alone", search: "fixes, each image alone", track: "fixes, tracked"};
const wayOf = method => WAYS[method] || `fixes, ${method}`;
const estimates = report.estimates.map(one => {
  const row = unpack(one.row), center = unpack(one.center), error = unpack(one.error), error_deg = unpack(one.error_deg);
  const which = unpack(one.reason.which), of = new Map(Array.from(row, (i, k) => [i, k]));
  return {row, center, quat: unpack(one.quat), error, error_deg, of, label: `${one.run}: ${wayOf(one.method)}`,
    reason: k => one.reason.texts[which[k]], located: k => Number.isFinite(center[3 * k])};
});

let chosenEstimates = estimates[0] || null;

// Error of the chosen estimate of a frame; NaN where there is none.
function estimateError(column, i) {
  const k = chosenEstimates ? chosenEstimates.of.get(i) : undefined;
  return k === undefined ? NaN : chosenEstimates[column][k];
}

// What each way made of a frame, one line each.
function estimateLines(i) {
  return estimates.filter(one => one.of.has(i)).map(one => {
    const k = one.of.get(i);
    if (!one.located(k)) return `${one.label}: no pose${one.reason(k) ? ` (${one.reason(k)})` : ""}`;
    if (!Number.isFinite(one.error[k])) return `${one.label}: a pose, without a label to compare it with`;
    return `${one.label}: off by ${figure(one.error[k], 2)} ${unit}, ${figure(one.error_deg[k], 2)}\u00b0`;
  });
}
