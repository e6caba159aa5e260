// Opens the page: reads it, draws what is on the screen first and then the rest, and follows theme and paper.
(async () => {
  "use strict";
  const H = window.haltereReport;
  H.fail = window.haltereFailed;
  if (typeof DecompressionStream === "undefined") {
    H.fail("this browser cannot inflate data; the plots need one from 2023 or newer");
    return;
  }
  const menu = document.getElementById("menu");
  menu.addEventListener("click", () => menu.setAttribute("aria-expanded", String(document.body.classList.toggle("menu"))));
  document.querySelector("nav .links").addEventListener("click", () => { document.body.classList.remove("menu"); menu.setAttribute("aria-expanded", "false"); });

  const [library, page, data] = await Promise.all([
    H.inflate("library", "deflate").text(), H.inflate("numbers", "deflate").json(), H.inflate("arrays", "deflate-raw").arrayBuffer(),
  ]);
  H.page = page;
  H.arrays = H.decode(page.arrays, new Uint8Array(data));
  for (const id of ["library", "numbers", "arrays"]) document.getElementById(id).remove();
  const script = document.createElement("script");
  script.textContent = library;
  document.head.append(script);
  const Plotly = (H.Plotly = window.Plotly);
  H.startTime();

  const divs = (H.divs = [...document.querySelectorAll("[data-figure]")]);
  for (const div of divs) {
    const box = Object.assign(document.createElement("div"), { className: "plot" });
    const hair = Object.assign(document.createElement("i"), { className: H.figure(div).time ? "hair" : "hair here", hidden: true });
    div.replaceWith(box);
    box.append(div, hair);
  }
  const solid = (div) => H.figure(div).kind === "3d";
  const redraw = async () => { for (const div of H.drawn) await H.draw(div); };
  H.dark.addEventListener("change", () => redraw().catch(H.fail));
  // Paper is light and as wide as a page; afterwards the screen is as it was.
  addEventListener("beforeprint", () => {
    H.printing = true;
    document.querySelectorAll("details.more:not([open])").forEach((d) => { d.open = true; d.dataset.folded = ""; });
    for (const div of divs) if (!solid(div) || H.drawn.has(div)) H.drawForPrint(div);
  });
  addEventListener("afterprint", () => {
    H.printing = false;
    document.querySelectorAll("details[data-folded]").forEach((d) => { d.open = false; delete d.dataset.folded; });
    (async () => { for (const div of divs) if (!solid(div) || H.drawn.has(div)) await H.draw(div); })().catch(H.fail);
  });

  const pause = () => new Promise((done) => setTimeout(done, 0));
  const flat = divs.filter((div) => !solid(div));
  for (const visible of [true, false]) {
    for (const div of flat) {
      if (H.drawn.has(div) || (visible && !H.nearby(div, 0))) continue;
      await H.draw(div);
      await pause();
    }
    if (visible) H.root.dataset.opened = String(Math.round(performance.now()));
  }
  divs.filter(solid).forEach(H.startView);
  H.root.dataset.ready = String(Math.round(performance.now()));
})().catch((e) => window.haltereFailed(e));
