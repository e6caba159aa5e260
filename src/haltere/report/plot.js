// Figures as the library wants them: colours of the theme, numbers of the window shown, shades of the flight modes.
(() => {
  "use strict";
  const H = window.haltereReport;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  H.dark = dark;
  H.printing = false;
  H.narrow = () => innerWidth < 700;
  H.touch = matchMedia("(pointer: coarse)").matches;
  H.drawn = new Set();
  H.shown = null; // the time window of all figures, null for the whole flight

  H.figure = (div) => H.page.figures[div.dataset.figure];
  H.colour = (word) => {
    const [name, alpha] = word.slice(1).split("/");
    const hex = H.page.colours[!H.printing && dark.matches ? "dark" : "light"][name];
    if (hex === undefined) return word;
    return alpha === undefined ? hex : hex + Math.round(255 * Number(alpha)).toString(16).padStart(2, "0");
  };

  const all = (id) => H.take(H.arrays[id], [...H.arrays[id].v.keys()]);

  // Figures name arrays and colours; here they get them.
  H.resolve = (value) => {
    if (Array.isArray(value)) return value.map(H.resolve);
    if (typeof value === "string") return value.startsWith("@") ? H.colour(value) : value;
    if (value === null || typeof value !== "object") return value;
    if ("$a" in value) return all(value.$a);
    if ("$b" in value) return all(value.$b).map((v) => (v === null ? null : value.k * v));
    const out = {};
    for (const key of Object.keys(value)) if (!key.startsWith("$")) out[key] = H.resolve(value[key]);
    return out;
  };

  // A closed outline a piece, so that a band stops where its line does.
  const outline = (time, line, sd, rows) => {
    const x = [], y = [];
    const usable = (i) => i >= 0 && !Number.isNaN(sd.v[i]);
    for (let i = 0; i < rows.length; ) {
      if (!usable(rows[i])) { i++; continue; }
      let j = i;
      while (j < rows.length && usable(rows[j])) j++;
      if (x.length) { x.push(null); y.push(null); }
      const edge = (k, sign) => {
        x.push(time.v[rows[k]] / time.s);
        y.push((line ? line.v[rows[k]] / line.s : 0) + (sign * sd.v[rows[k]]) / sd.s);
      };
      for (let k = i; k < j; k++) edge(k, 1);
      for (let k = j - 1; k >= i; k--) edge(k, -1);
      i = j;
    }
    return { x, y };
  };

  const refined = (figure, trace) =>
    trace.$band || trace.$track || trace.$labels || (figure.time && trace.x && trace.x.$a !== undefined && /lines/.test(trace.mode));

  // What of a trace changes with the window: about two points a pixel, and half a window more at either side for panning.
  const view = (figure, trace, width, cache) => {
    const whole = figure.time ? figure.layout.xaxis.range : H.page.span;
    const [a, b] = H.shown || whole;
    if (trace.$labels) return labels(trace.$labels, a, b, width);
    if (trace.$track) {
      const [time, north, east, down] = trace.$track.ids.map((id) => H.arrays[id]);
      if (trace.$track.window && !H.shown) return { x: [], y: [], ...(trace.type === "scatter3d" ? { z: [] } : {}), customdata: [], showlegend: false };
      const [from, to] = trace.$track.window ? [a, b] : whole;
      const key = `${trace.$track.ids}|${from}|${to}`;
      const rows = (cache[key] ||= H.rows(time, [north, east], from, to, 1500).filter((i) => i < 0 || (time.v[i] / time.s >= from && time.v[i] / time.s <= to)));
      const t = H.take(time, rows), d = H.take(down, rows);
      const out = { x: H.take(east, rows), y: H.take(north, rows), customdata: t.map((v, i) => [v, d[i]]) };
      if (trace.type === "scatter3d") out.z = d.map((v) => (v === null ? null : -v));
      if (trace.$track.window) out.showlegend = rows.length > 0;
      return out;
    }
    const margin = H.shown ? 0.5 * (b - a) : 0;
    const ids = trace.$band ? [trace.$band.t, trace.$band.line, trace.$band.sd] : [trace.x.$a, trace.y.$a ?? trace.y.$b];
    if (trace.customdata && trace.customdata.$a !== undefined) ids.push(trace.customdata.$a);
    const [time, ...columns] = ids.map((id) => H.arrays[id]);
    const steps = Math.ceil((width * (H.shown ? 2 : 1)) / columns.length);
    const rows = (cache[String(ids)] ||= H.rows(time, columns, a - margin, b + margin, steps));
    if (trace.$band) return outline(time, trace.$band.y === null ? null : columns[0], columns[1], rows);
    const out = { x: H.take(time, rows), y: H.take(columns[0], rows, trace.y.k) };
    if (columns[1]) out.customdata = H.take(columns[1], rows);
    // So few that they can be told apart: then each is marked.
    const few = rows.filter((i) => time.v[i] / time.s >= a && time.v[i] / time.s <= b).length < width / 8;
    if (trace.y.$a !== undefined) out.mode = few || /markers/.test(trace.mode) ? "lines+markers" : "lines";
    return out;
  };

  // Names in the middle of the bars that have room for them.
  const labels = ({ starts, ends, names, row }, a, b, width) => {
    const out = { x: [], y: [], text: [] };
    starts.forEach((start, i) => {
      const low = Math.max(start, a), high = Math.min(ends[i], b);
      if (((high - low) / (b - a)) * width < 7 * names[i].length + 6) return;
      out.x.push((low + high) / 2);
      out.y.push(row);
      out.text.push(names[i]);
    });
    return out;
  };

  const widthOf = (div) => Math.max(200, (H.printing ? 700 : div.clientWidth) - 90);

  const tracesOf = (div) => {
    const figure = H.figure(div), cache = {};
    return figure.traces.map((trace) => {
      if (!refined(figure, trace)) return H.resolve(trace);
      const { x, y, customdata, text, ...rest } = trace.$track || trace.$labels ? trace : { ...trace, text: undefined };
      return { ...H.resolve(rest), ...view(figure, trace, widthOf(div), cache) };
    });
  };

  const layoutOf = (div) => {
    const figure = H.figure(div);
    const layout = H.resolve(figure.layout);
    const font = { family: "system-ui, sans-serif", size: 12, color: H.colour("@text") };
    Object.assign(layout, {
      font, autosize: true, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      hovermode: layout.hovermode || "x unified",
      hoverlabel: { bgcolor: H.colour("@panel"), bordercolor: H.colour("@axis"), font, namelength: -1 },
      legend: { orientation: "h", x: 0, xanchor: "left", y: 1, yanchor: "bottom", font, bgcolor: "rgba(0,0,0,0)", ...layout.legend },
      modebar: { color: H.colour("@quiet"), activecolor: H.colour("@estimate"), bgcolor: "rgba(0,0,0,0)", orientation: "h" },
      dragmode: H.touch ? false : "zoom",
    });
    if (figure.time) {
      if (H.shown) layout.xaxis.range = [...H.shown];
      const shades = H.page.shades.map(([x0, x1, fillcolor]) => ({
        type: "rect", xref: "x", yref: "paper", x0, x1, y0: 0, y1: 1, layer: "below", fillcolor: H.colour(fillcolor), line: { width: 0 },
      }));
      layout.shapes = [...shades, ...(layout.shapes || [])];
    }
    return layout;
  };

  // The buttons are named one by one, so that a newer library adds none that would send something away.
  const configOf = (div) => ({
    responsive: true, displaylogo: false, displayModeBar: H.touch || H.narrow() ? false : "hover", showSendToCloud: false, plotlyServerURL: "",
    modeBarButtons: [
      H.figure(div).kind === "3d" ? ["orbitRotation", "pan3d", "resetCameraDefault3d"] : ["zoom2d", "pan2d", "resetScale2d"],
    ],
  });

  H.draw = async (div) => {
    const figure = H.figure(div);
    // A narrow legend takes more lines, which must not come off the panels.
    if (H.narrow() && !figure.compact) div.style.height = `${figure.height + 32}px`;
    const first = !H.drawn.has(div);
    await (first ? H.Plotly.newPlot : H.Plotly.react)(div, tracesOf(div), layoutOf(div), configOf(div));
    if (!first) return;
    H.drawn.add(div);
    H.root.dataset.drawn = String([...H.drawn].filter((d) => H.figure(d).kind !== "3d").length);
    H.dress(div);
  };

  // On paper, as wide as a page; the library draws at once.
  H.drawForPrint = (div) => {
    const layout = { ...layoutOf(div), autosize: false, width: 700, height: H.figure(div).height };
    (H.drawn.has(div) ? H.Plotly.react : H.Plotly.newPlot)(div, tracesOf(div), layout, configOf(div));
  };

  // The window has changed: new numbers for the traces that depend on it.
  H.refresh = (div) => {
    const figure = H.figure(div), cache = {};
    const which = [], update = {};
    figure.traces.forEach((trace, i) => {
      if (!refined(figure, trace)) return;
      const now = view(figure, trace, widthOf(div), cache);
      for (const key of Object.keys(now)) (update[key] ||= [])[which.length] = now[key];
      which.push(i);
    });
    for (const values of Object.values(update)) values.length = which.length; // a hole leaves what is there
    const layout = figure.time ? { "xaxis.range": [...(H.shown || figure.layout.xaxis.range)] } : {};
    return which.length ? H.Plotly.update(div, update, layout, which) : H.Plotly.relayout(div, layout);
  };
})();
