// Show the newest state of the service. Names of files and peers are untrusted: insert text only, never markup.
"use strict";

const MOST_POINTS = 1200; // ten minutes
const MOST_ROWS = 200;
const SILENT_MS = 3000; // silence of the server after which the state is marked as old
const AGAIN_MS = 2000;
const MOST_WAITING = 0.98; // a consumer that always waits gives no estimate of the rate it could use

const at = (id) => document.getElementById(id);
const hexOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function make(tag, text, kind) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (kind) element.className = kind;
  return element;
}

function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// --- formatting of numbers ---

const share = (value) => `${Math.round(100 * value)} %`;

function number(value) {
  if (value === 0) return "0";
  if (value < 10) return value.toFixed(2);
  if (value < 100) return value.toFixed(1);
  return Math.round(value).toLocaleString("en");
}

function seconds(value) {
  if (value === null || value === undefined) return "";
  if (value < 10) return `${value.toFixed(1)} s`;
  if (value < 120) return `${Math.round(value)} s`;
  if (value < 7200) return `${Math.round(value / 60)} min`;
  if (value < 48 * 3600) return `${(value / 3600).toFixed(1)} h`;
  return `${Math.round(value / 86400)} d`;
}

function bytes(value) {
  for (const unit of ["B", "kB", "MB", "GB", "TB"]) {
    if (value < 1000 || unit === "TB") return `${number(value)} ${unit}`;
    value /= 1000;
  }
}

// --- parts of the page ---

/** Sets the cells of a table. Rows are kept, and so is what a reader has marked; only what differs is written. */
function fill(id, rows, empty) {
  const body = at(id).tBodies[0];
  const columns = at(id).tHead ? at(id).tHead.rows[0].cells : [];
  const shown = rows.length ? rows.slice(0, MOST_ROWS) : [[{ text: empty, kind: "none" }]];
  if (rows.length > MOST_ROWS) shown.push([{ text: `and ${rows.length - MOST_ROWS} more`, kind: "none" }]);
  while (body.rows.length > shown.length) body.deleteRow(-1);
  shown.forEach((cells, line) => {
    const row = body.rows[line] || body.insertRow();
    while (row.cells.length > cells.length) row.deleteCell(-1);
    cells.forEach((cell, place) => {
      const told = typeof cell === "object" ? cell : { text: String(cell) };
      const box = row.cells[place] || row.insertCell();
      const wide = columns[place] && columns[place].className === "wide" ? "wide" : "";
      const kind = [told.kind, wide].filter(Boolean).join(" ");
      if (box.className !== kind) box.className = kind;
      if (told.part === undefined) {
        say(box, told.text);
      } else {
        if (!box.firstChild || !box.firstChild.classList) box.replaceChildren(bar(), make("span", "", "quiet"));
        box.firstChild.firstChild.style.width = `${100 * told.part}%`;
        say(box.lastChild, told.text);
      }
    });
    if (cells.length === 1 && columns.length) row.cells[0].colSpan = columns.length;
    else if (row.cells[0]) row.cells[0].removeAttribute("colspan");
  });
}

function bar() {
  const outer = make("div", undefined, "bar");
  outer.append(make("i"));
  return outer;
}

/** Pairs of a name and a value, in a list that is made once. */
function list(id, pairs, withBar) {
  const parent = at(id);
  while (parent.children.length > pairs.length) parent.lastChild.remove();
  pairs.forEach(([name, value, note], place) => {
    let item = parent.children[place];
    if (!item) {
      item = make("div");
      item.append(make("dt"), make("dd"));
      if (withBar) item.append(bar());
      parent.append(item);
    }
    const [label, figure] = item.children;
    say(label, name);
    if (withBar) {
      say(figure, share(value));
      item.children[2].firstChild.style.width = `${100 * value}%`;
    } else {
      if (!figure.firstChild) figure.append(make("span"), make("small"));
      say(figure.firstChild, value);
      say(figure.lastChild, note ? ` ${note}` : "");
    }
  });
}

// --- the two charts ---

const past = { speed: [[], [], []], waits: [[], [], [], []] };
const charts = {};

function remember(name, values) {
  past[name].forEach((column, place) => {
    column.push(values[place]);
    if (column.length > MOST_POINTS) column.shift();
  });
}

/** The axis of time: all that is remembered, and the last minute at least. uPlot's own range of one point is years. */
function timeRange(times) {
  const last = times.length ? times[times.length - 1] : Date.now() / 1000;
  return [Math.min(times.length ? times[0] : last, last - 60), last];
}

function chart(name, lines, isShare) {
  const box = at(name);
  const axis = { stroke: hexOf("--quiet"), grid: { stroke: hexOf("--line"), width: 1 }, ticks: { show: false } };
  const values = isShare ? (_, ticks) => ticks.map(share) : (_, ticks) => ticks.map(number);
  return new uPlot(
    {
      width: box.clientWidth,
      height: 190,
      legend: { show: false },
      cursor: { show: false },
      scales: {
        x: { range: () => timeRange(past[name][0]) },
        y: { range: isShare ? [0, 1] : (_, __, most) => [0, Math.max(most * 1.1, 0.1)] },
      },
      axes: [axis, { ...axis, values, size: 55 }],
      series: [{}, ...lines.map(([colour, dash]) => ({ stroke: hexOf(colour), width: 2, dash, points: { show: false } }))],
    },
    past[name],
    box,
  );
}

function drawCharts() {
  for (const name of Object.keys(charts)) charts[name].destroy();
  charts.speed = chart("speed", [["--blue"], ["--orange", [6, 4]]], false);
  charts.waits = chart("waits", [["--orange"], ["--blue"], ["--green", [6, 4]]], true);
}

function middle(values) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted.length ? sorted[Math.floor((sorted.length - 1) / 2)] : null;
}

// --- one state ---

function show(state) {
  const there = state.consumers.filter((each) => each.state !== "gone");
  const waits = there.map((each) => each.waiting_share);
  const wanted = state.batches_per_second / (1 - Math.min(state.waiting.shares.consumers, MOST_WAITING));
  const now = Date.now() / 1000;
  remember("speed", [now, state.batches_per_second, there.length ? wanted : null]);
  remember("waits", [now, waits.length ? Math.max(...waits) : null, middle(waits), state.waiting.shares.idle]);
  if (document.hidden) return;

  say(at("host"), state.host);
  say(at("address"), state.address);
  say(at("uptime"), `up ${seconds(state.uptime_seconds)}`);
  say(at("program"), `v2v-serve ${state.program}, ${state.videos}`);
  document.title = `${number(state.batches_per_second)} batches/s · v2v-serve`;
  at("verdict").dataset.part = state.waiting.part;
  say(at("sentence"), state.waiting.sentence);
  say(at("remedy"), state.waiting.remedy);
  const shares = fields.filter(({ place, unit }) => place === "waiting.shares" && unit === "0 to 1");
  list("shares", shares.map(({ name, words }) => [words, state.waiting.shares[name]]), true);
  list("tiles", tiles(state), false);
  fill("consumers", state.consumers.map(consumer), "no consumers are connected");
  fill("workers", state.workers.map(worker), "no workers are connected");
  fill("refusals", state.refusals.map(refusal), "no sequence was skipped");
  fill("verdicts", state.verdicts.map(refusal), "nothing");
  fill("recipe", settings(state.spec), "");
  fill("figures", figures(state), "");
  say(at("consumers-count"), `${state.consumer_count} connected`);
  say(at("workers-count"), workersCount(state));
  say(at("refusals-count"), `${state.totals.refused_candidates} times, the last few`);
  say(at("verdicts-count"), `${state.quarantined} entries`);
  charts.speed.setData(past.speed);
  charts.waits.setData(past.waits);
}

function workersCount(state) {
  const [least, most] = state.workers_wanted;
  const wanted = least === most ? `${least}` : `${least} to ${most}`;
  return `${state.worker_count} connected, ${state.worker_processes} processes here of ${wanted}`;
}

function tiles(state) {
  const totals = state.totals;
  const pairs = [
    ["batches a second", number(state.batches_per_second), `${number(totals.batches)} in total`],
    ["samples a second", number(state.samples_per_second), `${totals.samples.toLocaleString("en")} in total`],
    ["bytes a second", bytes(state.bytes_per_second), `${bytes(totals.bytes)} in total`],
    ["decodes a second", number(state.decodes_per_second), `${totals.decodes.toLocaleString("en")} in total`],
    ["queued", String(state.queue), "samples requested that no worker has begun"],
    ["faults", String(totals.faults), "handled: workers or videos that failed"],
    ["videos", state.video_count.toLocaleString("en"), `${state.unusable_count} cannot be used`],
  ];
  if (state.cache) {
    const cache = state.cache;
    const read = cache.hits + cache.misses;
    const held = cache.folder ? `hits, ${number(cache.held_gib)} of ${number(cache.most_gib)} GiB` : "hits";
    pairs.push(["cache", read ? share(cache.hits / read) : "empty", cache.trouble || held]);
  }
  return pairs;
}

function consumer(each) {
  return [
    each.host ? `${each.name || each.id.slice(0, 8)} on ${each.host}` : each.name || each.id.slice(0, 8),
    { text: each.state === "stalled" ? `waits ${share(each.waiting_share)}` : each.state, kind: `state ${each.state}` },
    each.epoch,
    { part: each.epoch_share, text: `${each.position} of ${each.sequences}` },
    seconds(each.eta_seconds),
    number(each.batches_per_second),
    share(each.waiting_share),
    `${each.in_flight} + ${each.waiting}`,
    each.credit,
    each.served.toLocaleString("en"),
  ];
}

function worker(each) {
  return [
    each.name,
    each.host,
    { text: each.unreadable ? `${each.state}: ${each.unreadable}` : each.state, kind: `state ${each.state}` },
    each.frame === null ? each.clip : `${each.clip} from frame ${each.frame}`,
    each.clip ? seconds(each.clip_seconds) : "",
    share(each.busy_share),
    number(each.cpu_share),
    each.memory_gib ? each.memory_gib.toFixed(2) : "",
    each.samples.toLocaleString("en"),
    each.restarts === null ? "" : each.restarts,
  ];
}

function refusal(each) {
  return [each.time.replace("T", " ").replace("+00:00", " UTC"), each.video, each.frame === null ? "" : each.frame, each.reason];
}

/** Every number that is not of one peer, with its meaning. */
function figures(state) {
  return fields.flatMap(({ place, name, words, help, unit, kind }) => {
    const part = place.split(".").reduce((found, key) => (key ? found && found[key] : found), state);
    if (kind === "text" || kind === "states" || Array.isArray(part) || !part || part[name] === null) return [];
    const known = part[name];
    if (unit === "0 to 1") return [[words, share(known), help]];
    const value = Number.isInteger(known) || typeof known !== "number" ? known.toLocaleString("en") : number(known);
    return [[words, unit ? `${value} ${unit}` : value, help]];
  });
}

function settings(spec, within = "") {
  return Object.entries(spec).flatMap(([key, value]) =>
    value !== null && typeof value === "object" && !Array.isArray(value)
      ? settings(value, `${within}${key}.`)
      : [[`${within}${key}`, Array.isArray(value) ? value.join(" .. ") : String(value)]],
  );
}

// --- listening ---

let heard = 0;
let fields = []; // what each number means

function trouble(text) {
  at("lost").hidden = !text;
  say(at("lost"), text);
  document.querySelector("main").classList.toggle("stale", Boolean(text));
}

function listen() {
  const events = new EventSource("/events");
  events.addEventListener("open", async () => {
    fields = await (await fetch("/fields")).json();
  });
  events.addEventListener("state", (event) => {
    heard = Date.now();
    trouble("");
    show(JSON.parse(event.data));
  });
  events.addEventListener("trouble", (event) => {
    heard = Date.now();
    trouble(`${JSON.parse(event.data).trouble}. The state shown is old; this page retries.`);
  });
  events.addEventListener("error", () => {
    if (events.readyState !== EventSource.CLOSED) return; // the browser tries again by itself
    events.close();
    setTimeout(listen, AGAIN_MS);
  });
}

drawCharts();
listen();
setInterval(() => {
  if (Date.now() - heard > SILENT_MS) trouble("The server does not answer. The state shown is old; this page retries.");
}, 1000);
new ResizeObserver(() => {
  for (const name of Object.keys(charts)) charts[name].setSize({ width: at(name).clientWidth, height: 190 });
}).observe(at("speed"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawCharts);
