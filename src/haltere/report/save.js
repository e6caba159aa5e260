// Pictures and numbers to keep: what each plot shows as SVG, PNG or CSV; and how fine its data are.
(() => {
  "use strict";
  const H = window.haltereReport;
  H.savePicture = (div, format) =>
    H.Plotly.downloadImage(div, {
      format, filename: H.figure(div).name, scale: format === "png" ? 2 : 1, width: div.clientWidth, height: div.clientHeight,
    }).catch(H.fail);

  const plain = (html) => new DOMParser().parseFromString(html || "", "text/html").body.textContent;
  const cell = (value) => {
    if (value === null || value === undefined) return "";
    const text = String(value);
    return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };

  // Columns of a figure: their heading, what they are ordered by, and their values at the finest resolution the page holds.
  const columnsOf = (div) => {
    const figure = H.figure(div), out = [];
    const number = (id) => { const { v, s } = H.arrays[id]; return (i) => (Number.isNaN(v[i]) ? null : v[i] / s); };
    const list = (ref) => (Array.isArray(ref) ? { n: ref.length, at: (i) => ref[i] } : { n: H.arrays[ref.$a ?? ref.$b].v.length, at: number(ref.$a ?? ref.$b) });
    figure.traces.forEach((trace, k) => {
      if (trace.$band || trace.$labels || (trace.type === "scatter3d" && !trace.$track) || (trace.$track && trace.$track.window) || div.data[k].visible === "legendonly") return;
      const title = (axis) => plain(((figure.layout[axis.replace(/^([xy])/, "$1axis")] || {}).title || {}).text);
      const name = plain(trace.name);
      if (trace.$track) {
        const [t, ...rest] = trace.$track.ids.map((id) => list({ $a: id }));
        ["north", "east", "down"].forEach((word, i) => out.push({ head: `${name} ${word} [m]`, key: t, at: rest[i].at }));
        return;
      }
      if (!trace.x || !trace.y) return;
      const key = list(trace.x), y = list(trace.y), head = `${name} ${title(trace.yaxis || "y")}`.trim();
      const factor = trace.y.k ?? 1;
      if (factor < 0) return; // the other side of a bound
      out.push({ head, key, at: factor === 1 ? y.at : (i) => { const v = y.at(i); return v === null ? null : v * factor; } });
      if (trace.customdata && trace.customdata.$a !== undefined) out.push({ head: head.replace(name, `${name} 1σ`), key, at: list(trace.customdata).at });
      if (Array.isArray(trace.text)) out.push({ head: `${name} note`, key, at: (i) => plain(trace.text[i]) });
    });
    if (figure.pose && !figure.windowed) {
      ["roll", "pitch", "yaw"].forEach((word, k) => {
        const [key, value] = figure.pose.angles[k].map((id) => list({ $a: id }));
        out.push({ head: `${word} [deg]`, key, at: value.at });
      });
    }
    return out;
  };

  // One row for each distinct key in the window, empty where a column has nothing there.
  H.csv = (div) => {
    const figure = H.figure(div);
    const timed = figure.time || figure.windowed || figure.pose;
    const [low, high] = timed && H.shown ? H.shown : [-Infinity, Infinity];
    const axis = plain(((figure.layout.xaxis || {}).title || {}).text);
    const rows = figure.table ? tableRows(figure.table, low, high) : null;
    if (rows) return rows;
    const columns = columnsOf(div);
    const cursors = columns.map(({ key }) => {
      const order = [];
      for (let i = 0; i < key.n; i++) { const x = key.at(i); if (x !== null && x >= low && x <= high) order.push(i); }
      return order;
    });
    const keys = new Set();
    columns.forEach(({ key, at }, c) => { cursors[c] = cursors[c].filter((i) => at(i) !== null); for (const i of cursors[c]) keys.add(key.at(i)); });
    const where = new Map([...Float64Array.from(keys).sort()].map((x, i) => [x, i]));
    const lines = [...where.keys()].map((x) => [x]);
    columns.forEach(({ key, at }, c) => { for (const i of cursors[c]) lines[where.get(key.at(i))][c + 1] = at(i); });
    const parts = [[figure.windowed || figure.pose ? "t [s]" : axis, ...columns.map(({ head }) => head)].map(cell).join(",")];
    for (const line of lines) { line.length = columns.length + 1; parts.push(Array.from(line, cell).join(",")); }
    return parts.join("\n") + "\n";
  };

  // Rows that a figure brings with it: each at a time, or from one to another.
  const tableRows = ({ heads, rows }, low, high) => {
    const last = heads[1] === "to [s]" ? 1 : 0;
    const shown = rows.filter((row) => row[last] >= low && row[0] <= high);
    return [heads, ...shown].map((row) => row.map((v) => cell(typeof v === "string" ? plain(v) : v)).join(",")).join("\n") + "\n";
  };

  H.saveData = (div) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([H.csv(div)], { type: "text/csv;charset=utf-8" }));
    link.download = `${H.figure(div).name}.csv`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };

  // How many of the samples a figure's lines hold.
  const fineness = (figure) => {
    const kept = new Map();
    let lines = 0;
    for (const trace of figure.traces) {
      const id = trace.$track ? trace.$track.ids[0] : trace.x && trace.x.$a;
      if (id === undefined || trace.$band || trace.showlegend === false && kept.has(trace.name) || !H.arrays[id].of) continue;
      lines++;
      const { of, kept: k } = H.arrays[id];
      if (k < of) kept.set(trace.name, Math.max(kept.get(trace.name) || 0, of / k));
    }
    if (!lines) return "";
    if (!kept.size) return "Zoom in to see every sample.";
    const words = [...kept].map(([name, n]) => `${plain(name)} 1 of ${n < 9.95 ? n.toFixed(1) : n.toFixed(0)} samples`).join(", ");
    return `Kept, with all extremes: ${words}; of the rest every sample.`;
  };

  const button = (text, title, act) => {
    const b = document.createElement("button");
    b.type = "button";
    b.textContent = text;
    b.title = title;
    b.setAttribute("aria-label", title);
    b.addEventListener("click", act);
    return b;
  };

  // What stands under a figure: what can be saved, how fine it is, and on a phone the zoom that a pointer finds above it.
  H.dress = (div) => {
    const box = div.parentElement, figure = H.figure(div);
    const said = fineness(figure);
    const fine = document.createElement("p");
    fine.className = "fine";
    fine.textContent = said;
    const tools = document.createElement("div");
    tools.className = "tools";
    if (figure.time) {
      const zoom = document.createElement("span");
      tools.append(zoom);
      zoom.append(
        button("−", "Show a longer time", () => H.zoom(2)), button("+", "Show a shorter time", () => H.zoom(0.5)),
        button("◂", "Earlier", () => H.pan(-0.5)), button("▸", "Later", () => H.pan(0.5)),
      );
    }
    tools.append(
      button("PNG", "Save as PNG", () => H.savePicture(div, "png")), button("SVG", "Save as SVG", () => H.savePicture(div, "svg")),
      button("CSV", "Save the data shown as CSV", () => H.saveData(div)),
    );
    tools.append(fine);
    box.append(tools);
    H.link(div);
  };
})();
