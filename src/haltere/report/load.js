// The numbers of the page: inflated, decoded, and thinned for what is on the screen.
(() => {
  "use strict";
  const H = (window.haltereReport = { root: document.documentElement });

  H.inflate = (id, format) => {
    const text = atob(document.getElementById(id).textContent);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format)));
  };

  // Integers in as few bytes as hold them exactly, NaN where nothing was measured; value = v[i] / s.
  H.decode = (metas, bytes) => {
    let at = 0;
    const arrays = [];
    for (const m of metas) {
      if (m.same !== undefined) { arrays.push({ ...arrays[m.same], ...m }); continue; }
      let missing = null, count = m.n;
      if (m.x) {
        missing = bytes.subarray(at, (at += m.n));
        for (let i = 0; i < m.n; i++) count -= missing[i];
      }
      const steps = new Float64Array(count);
      for (let w = 0, unit = 1; w < m.w; w++, unit *= 256) for (let i = 0; i < count; i++) steps[i] += unit * bytes[at++];
      for (let i = 0; i < count; i++) steps[i] = steps[i] % 2 ? -(steps[i] + 1) / 2 : steps[i] / 2;
      for (let k = 0; k < m.o; k++) for (let i = 1; i < count; i++) steps[i] += steps[i - 1];
      let largest = 0;
      for (let i = 0; i < count; i++) largest = Math.max(largest, Math.abs(steps[i]));
      const v = new (largest < 2 ** 24 ? Float32Array : Float64Array)(m.n);
      if (missing) for (let i = 0, from = 0; i < m.n; i++) v[i] = missing[i] ? NaN : steps[from++];
      else v.set(steps);
      arrays.push({ ...m, v });
    }
    return arrays;
  };

  // First index whose value is not below x (in units of the array).
  H.lower = (array, x) => {
    const { v, s } = array;
    let low = 0, high = v.length;
    while (low < high) { const mid = (low + high) >> 1; if (v[mid] / s < x) low = mid + 1; else high = mid; }
    return low;
  };

  // Value at a time by straight lines; null outside and where the line is broken.
  H.at = (time, array, t) => {
    const i = H.lower(time, t), { v, s } = array;
    if (i >= v.length || (i === 0 && time.v[0] / time.s > t)) return null;
    if (i === 0) return v[0] / s;
    const [a, b] = [time.v[i - 1] / time.s, time.v[i] / time.s];
    const [p, q] = [v[i - 1] / s, v[i] / s];
    if (Number.isNaN(q)) return Number.isNaN(p) ? null : p;
    if (Number.isNaN(p) || b === a) return q;
    return p + ((q - p) * (t - a)) / (b - a);
  };

  // Rows to draw between two times: all of them where they are few, else the smallest and the largest of every column in each
  // of so many steps; -1 where the line is broken.
  H.rows = (time, columns, from, to, steps) => {
    const T = time.v, last = T.length - 1;
    const first = Math.max(0, H.lower(time, from) - 1), end = Math.min(last, H.lower(time, to) + 1);
    const Y = columns[0].v, out = [];
    const lineBreak = () => { if (out.length && out[out.length - 1] !== -1) out.push(-1); };
    if (end - first + 1 <= 2 * columns.length * steps) {
      for (let i = first; i <= end; i++) if (Number.isNaN(Y[i])) lineBreak(); else out.push(i);
      return out;
    }
    const scale = steps / Math.max(1e-9, Math.min(to, T[last] / time.s) - Math.max(from, T[0] / time.s)) / time.s;
    const extremes = new Int32Array(2 * columns.length).fill(-1);
    let bucket = -1;
    const flush = () => {
      const rows = [...extremes].filter((i) => i >= 0).sort((a, b) => a - b);
      for (let k = 0; k < rows.length; k++) if (!k || rows[k] !== rows[k - 1]) out.push(rows[k]);
      extremes.fill(-1);
    };
    for (let i = first; i <= end; i++) {
      if (Number.isNaN(Y[i])) { flush(); lineBreak(); continue; }
      const now = Math.floor((T[i] - T[first]) * scale);
      if (now !== bucket) { flush(); bucket = now; }
      for (let c = 0; c < columns.length; c++) {
        const v = columns[c].v, value = v[i];
        if (Number.isNaN(value)) continue;
        if (extremes[2 * c] < 0 || value < v[extremes[2 * c]]) extremes[2 * c] = i;
        if (extremes[2 * c + 1] < 0 || value > v[extremes[2 * c + 1]]) extremes[2 * c + 1] = i;
      }
    }
    flush();
    return out;
  };

  H.take = (array, rows, k = 1) => rows.map((i) => (i < 0 || Number.isNaN(array.v[i]) ? null : (k * array.v[i]) / array.s));
})();
