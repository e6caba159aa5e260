// One time for all figures: the window they show, the moment pointed at, and the address that opens the same window again.
(() => {
  "use strict";
  const H = window.haltereReport;
  const stale = new Set();
  const following = new WeakSet();
  const timed = () => [...H.drawn].filter((div) => H.figure(div).time || H.figure(div).windowed);

  H.nearby = (div, reach = 200) => {
    const box = div.getBoundingClientRect();
    return box.bottom > -reach && box.top < innerHeight + reach;
  };

  const follow = (div) => {
    stale.delete(div);
    following.add(div);
    return Promise.resolve(H.refresh(div)).then(() => following.delete(div));
  };
  H.settle = () => Promise.all([...stale].map(follow));

  const fromAddress = () => {
    const found = /^#t=(-?\d+(?:\.\d+)?)-(-?\d+(?:\.\d+)?)$/.exec(location.hash);
    const range = found && [Number(found[1]), Number(found[2])];
    if (!range || range[0] >= Math.min(range[1], H.page.span[1]) || range[1] <= H.page.span[0]) return null; // no time of this flight
    return range;
  };

  const tell = () => {
    H.root.dataset.window = JSON.stringify(H.shown);
    const box = document.getElementById("window");
    box.hidden = H.shown === null;
    if (H.shown) box.querySelector("span").textContent = `t = ${H.shown.map((t) => t.toFixed(H.shown[1] - H.shown[0] < 1 ? 3 : 1)).join(" to ")} s`;
    const digits = H.shown && Math.max(2, Math.ceil(3 - Math.log10(H.shown[1] - H.shown[0])));
    const address = H.shown ? `#t=${H.shown.map((t) => t.toFixed(Math.min(digits, 6))).join("-")}` : "";
    if (!H.shown && !location.hash.startsWith("#t=")) return;
    try { history.replaceState(null, "", address || location.pathname + location.search); } catch { /* an opaque origin has no history */ }
  };

  // The visible figures show the window at once, the others when they come into view.
  H.show = (range) => {
    const [low, high] = H.page.span, least = 1e-3;
    if (range && range[1] - range[0] < least) range = [range[0], range[0] + least];
    H.shown = range && (range[0] > low || range[1] < high) ? [...range] : null;
    tell();
    const now = timed().filter((div) => H.nearby(div) || (stale.add(div), false));
    return Promise.all(now.map(follow));
  };

  const moved = (div, change) => {
    if (following.has(div) || H.printing) return;
    const keys = Object.keys(change);
    if (!keys.some((k) => /^xaxis\.(range|autorange)/.test(k))) return;
    H.show(keys.includes("xaxis.autorange") ? null : div.layout.xaxis.range.map(Number)).catch(H.fail);
  };

  // The share of the window to move it by, and the factor to widen it by.
  H.pan = (share) => {
    if (!H.shown) return;
    const [a, b] = H.shown, [low, high] = H.page.span;
    const step = Math.min(Math.max(share * (b - a), low - a), high - b);
    H.show([a + step, b + step]).catch(H.fail);
  };
  H.zoom = (factor) => {
    const [a, b] = H.shown || H.page.span, [low, high] = H.page.span;
    const middle = H.moment !== null && H.moment > a && H.moment < b ? H.moment : (a + b) / 2;
    H.show([Math.max(low, middle - factor * (middle - a)), Math.min(high, middle + factor * (b - middle))]).catch(H.fail);
  };

  const keys = {
    Home: () => H.show(null).catch(H.fail), ArrowLeft: () => H.pan(-0.25), ArrowRight: () => H.pan(0.25), "+": () => H.zoom(0.5), "-": () => H.zoom(2),
  };
  addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.altKey || e.metaKey || /^(INPUT|SELECT|TEXTAREA|BUTTON|SUMMARY)$/.test(e.target.tagName) || !keys[e.key]) return;
    if (e.key === "Home" && !H.shown) return;
    e.preventDefault();
    keys[e.key]();
  });
  addEventListener("hashchange", () => { const range = fromAddress(); if (range) H.show(range).catch(H.fail); });

  // A line at the moment pointed at in every visible figure, and what they show there.
  H.moment = null;
  let waiting = false;
  const place = (div, t) => {
    const hair = div.parentElement.querySelector(".hair"), axis = div._fullLayout && div._fullLayout.xaxis;
    const x = t === null || !axis ? NaN : axis._offset + axis.l2p(t);
    const size = div._fullLayout && div._fullLayout._size;
    const visible = size && x >= size.l && x <= size.l + size.w;
    hair.hidden = !visible;
    if (visible) Object.assign(hair.style, { left: `${x}px`, top: `${size.t}px`, height: `${size.h}px` });
  };
  const here = (div, t) => {
    const dot = div.parentElement.querySelector(".hair"), { ids } = H.figure(div).windowed, full = div._fullLayout;
    const [north, east] = t === null ? [null, null] : [1, 2].map((k) => H.at(H.arrays[ids[0]], H.arrays[ids[k]], t));
    dot.hidden = north === null || !full;
    if (!dot.hidden) Object.assign(dot.style, { left: `${full.xaxis._offset + full.xaxis.l2p(east)}px`, top: `${full.yaxis._offset + full.yaxis.l2p(north)}px` });
  };
  const point = (source) => {
    waiting = false;
    for (const div of timed()) {
      if (!H.nearby(div, 0)) continue;
      const figure = H.figure(div);
      if (figure.kind === "3d") continue;
      if (!figure.time) { here(div, H.moment); continue; }
      place(div, H.moment);
      if (div === source || figure.layout.hovermode === "closest") continue;
      if (H.moment === null) H.Plotly.Fx.unhover(div); else H.Plotly.Fx.hover(div, { xval: H.moment }, "xy");
    }
    if (H.pose && H.moment !== null) H.pose(H.moment);
  };
  H.pointAt = (t, source) => {
    H.moment = t;
    H.root.dataset.moment = String(t);
    if (waiting) return;
    waiting = true;
    setTimeout(() => point(source), 16);
  };

  const watcher = new IntersectionObserver((entries) => {
    for (const e of entries) if (e.isIntersecting && stale.has(e.target)) follow(e.target).catch(H.fail);
  }, { rootMargin: "200px" });

  H.link = (div) => {
    const figure = H.figure(div);
    watcher.observe(div);
    if (figure.time) div.on("plotly_relayout", (change) => moved(div, change));
    if (!figure.time && !figure.windowed) return;
    div.on("plotly_hover", (e) => {
      if (e.event && e.event.xval !== undefined) return; // one that this page asked for
      const t = figure.time ? e.xvals[0] : Array.isArray(e.points[0].customdata) ? e.points[0].customdata[0] : null;
      if (typeof t === "number") H.pointAt(t, div);
    });
    div.on("plotly_unhover", (e) => { if (!e || !e.event || e.event.xval === undefined) H.pointAt(null, div); });
  };

  H.startTime = () => {
    document.querySelector("#window button").addEventListener("click", () => H.show(null).catch(H.fail));
    H.shown = fromAddress();
    if (H.shown) tell();
  };
})();
