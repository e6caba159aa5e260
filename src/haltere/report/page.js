// Inflates the library and the numbers, draws every figure, and keeps the time axes together.
(async () => {
  "use strict";
  const root = document.documentElement;
  const fail = window.haltereFailed;

  if (typeof DecompressionStream === "undefined") {
    fail("this browser cannot inflate data; the plots need one from 2023 or newer");
    return;
  }

  const inflate = async (id) => {
    const text = atob(document.getElementById(id).textContent);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).text();
  };

  const [library, numbers] = await Promise.all([inflate("library"), inflate("numbers")]);
  const script = document.createElement("script");
  script.textContent = library;
  document.head.append(script);
  const Plotly = window.Plotly;
  const page = JSON.parse(numbers);

  // Differences of integers, null where nothing was measured.
  const arrays = page.arrays.map(({ s, d }) => {
    const out = new Array(d.length);
    for (let i = 0, sum = 0; i < d.length; i++) out[i] = d[i] === null ? null : (sum += d[i]) / s;
    return out;
  });

  const scaled = (k, b) => b.map((v) => (v === null ? null : k * v));

  // A closed outline a piece, so that a band stops where its line does.
  const outline = ({ t, y, sd }) => {
    const [T, S, Y] = [arrays[t], arrays[sd], y === null ? null : arrays[y]];
    const x = [], v = [];
    for (let i = 0; i < T.length; ) {
      if (S[i] === null || (Y && Y[i] === null)) { i++; continue; }
      let j = i;
      while (j < T.length && S[j] !== null && (!Y || Y[j] !== null)) j++;
      if (x.length) { x.push(null); v.push(null); }
      for (let k = i; k < j; k++) { x.push(T[k]); v.push((Y ? Y[k] : 0) + S[k]); }
      for (let k = j - 1; k >= i; k--) { x.push(T[k]); v.push((Y ? Y[k] : 0) - S[k]); }
      i = j;
    }
    return { x, y: v };
  };

  const dark = matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  const colour = (word) => {
    const [name, alpha] = word.slice(1).split("/");
    const hex = page.colours[!printing && dark.matches ? "dark" : "light"][name];
    if (hex === undefined) return word;
    if (alpha === undefined) return hex;
    return hex + Math.round(255 * Number(alpha)).toString(16).padStart(2, "0");
  };

  // Figures name arrays and colours; here they get them.
  const resolve = (value) => {
    if (Array.isArray(value)) return value.map(resolve);
    if (typeof value === "string") return value.startsWith("@") ? colour(value) : value;
    if (value === null || typeof value !== "object") return value;
    if ("$a" in value) return arrays[value.$a];
    if ("$b" in value) return scaled(value.k, arrays[value.$b]);
    if ("$zip" in value) return arrays[value.$zip[0]].map((_, i) => value.$zip.map((id) => arrays[id][i]));
    const out = {};
    for (const key of Object.keys(value)) {
      if (key === "$band") Object.assign(out, outline(value.$band));
      else out[key] = resolve(value[key]);
    }
    return out;
  };

  const divs = [...document.querySelectorAll("[data-figure]")];
  const drawn = new Set();
  const stale = new Set();
  let shownTime = null; // the time window of all figures, null for the whole flight
  const touch = matchMedia("(pointer: coarse)").matches;

  const timeAxes = (layout) => Object.keys(layout).filter((k) => k.startsWith("xaxis"));

  const layoutOf = (figure) => {
    const layout = resolve(figure.layout);
    const font = { family: "system-ui, sans-serif", size: 12, color: colour("@text") };
    Object.assign(layout, {
      font, autosize: true, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      hovermode: layout.hovermode || "x unified",
      hoverlabel: { bgcolor: colour("@panel"), bordercolor: colour("@axis"), font, namelength: -1 },
      legend: { orientation: "h", x: 0, xanchor: "left", y: 1, yanchor: "bottom", font, bgcolor: "rgba(0,0,0,0)" },
      modebar: { color: colour("@quiet"), activecolor: colour("@estimate"), bgcolor: "rgba(0,0,0,0)", orientation: "h" },
      dragmode: touch ? false : "zoom",
    });
    if (figure.time && shownTime) for (const k of timeAxes(layout)) layout[k].range = [...shownTime];
    return layout;
  };

  // The buttons are named one by one, so that a newer library adds none that would send something away.
  const configOf = (figure) => ({
    responsive: true, displaylogo: false, displayModeBar: touch || innerWidth < 700 ? false : "hover", showSendToCloud: false, plotlyServerURL: "",
    modeBarButtons: [
      ["SVG", "PNG"].map((kind) => ({
        name: kind, title: `Save as ${kind}`, icon: kind === "SVG" ? Plotly.Icons.camera : Plotly.Icons["camera-retro"],
        click: (div) => Plotly.downloadImage(div, { format: kind.toLowerCase(), filename: figure.name, scale: kind === "PNG" ? 2 : 1 }),
      })),
      ["zoom2d", "pan2d", "resetScale2d"],
    ],
  });

  const setWindow = (div) => {
    const figure = page.figures[div.dataset.figure];
    const range = shownTime || figure.layout.xaxis.range;
    const update = {};
    for (const k of timeAxes(figure.layout)) update[k + ".range"] = [...range];
    stale.delete(div);
    div.dataset.following = "1";
    return Plotly.relayout(div, update).then(() => delete div.dataset.following);
  };

  const nearby = (div) => {
    const box = div.getBoundingClientRect();
    return box.bottom > -200 && box.top < innerHeight + 200;
  };

  // One axis moved: the visible figures follow at once, the others when they come into view.
  const follow = (source, change) => {
    if (source.dataset.following || printing) return;
    const keys = Object.keys(change);
    if (!keys.some((k) => /^xaxis\d*\.(range|autorange)/.test(k))) return;
    const figure = page.figures[source.dataset.figure];
    const whole = figure.layout.xaxis.range;
    const now = source.layout.xaxis.range.map(Number);
    const all = keys.some((k) => /^xaxis\d*\.autorange/.test(k)) || (now[0] === whole[0] && now[1] === whole[1]);
    shownTime = all ? null : now;
    root.dataset.window = JSON.stringify(shownTime);
    for (const div of divs) {
      if (div === source || !page.figures[div.dataset.figure].time || !drawn.has(div)) continue;
      if (nearby(div)) setWindow(div);
      else stale.add(div);
    }
    if (all) setWindow(source);
  };

  const draw = async (div) => {
    const figure = page.figures[div.dataset.figure];
    // A narrow legend takes more lines, which must not come off the panels.
    if (innerWidth < 700) div.style.height = `${figure.height + 32}px`;
    await Plotly.newPlot(div, resolve(figure.traces), layoutOf(figure), configOf(figure));
    drawn.add(div);
    root.dataset.drawn = String(drawn.size);
    if (figure.time) div.on("plotly_relayout", (change) => follow(div, change));
  };

  const redraw = async () => {
    for (const div of drawn) {
      const figure = page.figures[div.dataset.figure];
      await Plotly.react(div, resolve(figure.traces), layoutOf(figure), configOf(figure));
      stale.delete(div);
    }
  };

  // What is on the screen first, then the rest, a figure at a time.
  const pause = () => new Promise((done) => setTimeout(done, 0));
  const waiting = new Set(divs);
  const drawAll = async () => {
    for (const visible of [true, false]) {
      for (const div of divs) {
        if (!waiting.has(div) || (visible && !nearby(div))) continue;
        waiting.delete(div);
        await draw(div);
        await pause();
      }
      if (visible) root.dataset.opened = String(Math.round(performance.now()));
    }
    root.dataset.ready = String(Math.round(performance.now()));
  };

  const watcher = new IntersectionObserver((entries) => {
    for (const e of entries) if (e.isIntersecting && stale.has(e.target)) setWindow(e.target);
  }, { rootMargin: "200px" });
  divs.forEach((div) => watcher.observe(div));

  dark.addEventListener("change", () => redraw().catch(fail));
  // Paper is light and as wide as a page; afterwards the screen is as it was.
  addEventListener("beforeprint", () => {
    printing = true;
    for (const div of drawn) {
      const figure = page.figures[div.dataset.figure];
      Plotly.react(div, resolve(figure.traces), { ...layoutOf(figure), autosize: false, width: 700, height: div.offsetHeight }, configOf(figure));
    }
  });
  addEventListener("afterprint", () => { printing = false; redraw().catch(fail); });

  window.haltereReport = { divs, setWindow, settle: () => Promise.all([...stale].map(setWindow)) };
  await drawAll();
})().catch((e) => window.haltereFailed(e));
