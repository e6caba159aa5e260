// The flight in three dimensions: tracks, body axes along the way, and an airframe that a slider or the other plots move.
(() => {
  "use strict";
  const H = window.haltereReport;
  const RAD = Math.PI / 180;

  const webgl = () => {
    try { return ["webgl2", "webgl"].some((kind) => document.createElement("canvas").getContext(kind)); } catch { return false; }
  };

  // Body to east, north, up, from roll, pitch and yaw in degrees: columns are forward, right, down.
  const turn = (roll, pitch, yaw) => {
    const [cr, sr, cp, sp, cy, sy] = [roll, pitch, yaw].flatMap((a) => [Math.cos(a * RAD), Math.sin(a * RAD)]);
    const north = [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy];
    const east = [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy];
    const down = [-sp, sr * cp, cr * cp];
    return [east, north, down.map((d) => -d)];
  };
  const placed = (R, p, [x, y, z]) => R.map((row, i) => p[i] + row[0] * x + row[1] * y + row[2] * z);

  const poseAt = (pose, t) => {
    const at = ([time, value]) => H.at(H.arrays[time], H.arrays[value], t);
    const angles = pose.angles.map(at), ned = pose.position ? pose.position.map(at) : [0, 0, 0];
    if ([...angles, ...ned].includes(null)) return null;
    return { angles, ned, R: turn(...angles), p: [ned[1], ned[0], -ned[2]] };
  };

  // Forward, right and down as three lines with gaps.
  const triads = (pose, times, size) => {
    const axes = [0, 1, 2].map(() => ({ x: [], y: [], z: [] }));
    for (const t of times) {
      const at = poseAt(pose, t);
      if (!at) continue;
      axes.forEach((line, k) => {
        const tip = placed(at.R, at.p, [0, 1, 2].map((i) => (i === k ? size : 0)));
        ["x", "y", "z"].forEach((c, i) => line[c].push(at.p[i], tip[i], null));
      });
    }
    return axes;
  };

  // Four arms, and a nose; lines of the airframe in body axes, of unit size.
  const ARMS = [[0.7, 0.7, 0], [-0.7, -0.7, 0], null, [0.7, -0.7, 0], [-0.7, 0.7, 0]];
  const circle = (x, y) => [null, ...Array.from({ length: 13 }, (_, k) => [x + 0.32 * Math.cos((k * Math.PI) / 6), y + 0.32 * Math.sin((k * Math.PI) / 6), -0.08])];
  const FRAME = [...ARMS, ...circle(0.7, 0.7), ...circle(-0.7, -0.7), ...circle(0.7, -0.7), ...circle(-0.7, 0.7)];
  const NOSE = [[0, 0, 0], [1.25, 0, 0], [1.0, 0.12, 0], null, [1.25, 0, 0], [1.0, -0.12, 0]];
  const BELLY = [[0, 0, 0], [0, 0, 0.6]];
  const shape = (points, R, p, size) => {
    const out = { x: [], y: [], z: [] };
    for (const point of points) {
      const q = point ? placed(R, p, point.map((v) => v * size)) : [null, null, null];
      ["x", "y", "z"].forEach((c, i) => out[c].push(q[i]));
    }
    return out;
  };
  const airframe = (at, size) => [FRAME, NOSE, BELLY].map((points) => shape(points, at.R, at.p, size));

  // Equal scales on all axes; flat flights still get some height.
  const frame = (figure, scene) => {
    const { pose } = figure;
    if (!pose.position) {
      for (const axis of ["xaxis", "yaxis", "zaxis"]) scene[axis].range = [-1.3, 1.3];
      return { size: 0.8, triad: 0 };
    }
    const [n, e, d] = pose.position.map(([, id]) => {
      const { v, s } = H.arrays[id];
      let low = Infinity, high = -Infinity;
      for (const x of v) if (x < low) low = x;
      for (const x of v) if (x > high) high = x;
      return [low / s, high / s];
    });
    const ranges = [e, n, [-d[1], -d[0]]];
    const largest = Math.max(1, ...ranges.map(([a, b]) => b - a));
    const size = 0.05 * largest;
    const spans = ranges.map(([a, b]) => Math.max(b - a, 0.3 * largest) + 2.6 * size);
    ["xaxis", "yaxis", "zaxis"].forEach((axis, k) => {
      const middle = 0.5 * (ranges[k][0] + ranges[k][1]);
      scene[axis].range = [middle - 0.5 * spans[k], middle + 0.5 * spans[k]];
    });
    const unit = 1.9 / (spans[0] + spans[1] + spans[2]) * 1.6;
    scene.aspectmode = "manual";
    scene.aspectratio = { x: spans[0] * unit, y: spans[1] * unit, z: spans[2] * unit };
    return { size, triad: 0.8 * size };
  };

  const line = (name, colour, width, data, showlegend) => ({
    type: "scatter3d", mode: "lines", name, legendgroup: name, showlegend, hoverinfo: "skip", line: { color: `@${colour}`, width }, connectgaps: false, ...data,
  });

  const open = async (div) => {
    const figure = H.figure(div), { pose } = figure;
    const time = H.arrays[pose.angles[0][0]];
    const [first, last] = [time.v[0] / time.s, time.v[time.v.length - 1] / time.s];
    const { size, triad } = frame(figure, figure.layout.scene);
    const start = poseAt(pose, first) || { R: turn(0, 0, 0), p: [0, 0, 0] };
    if (triad) {
      const times = Array.from({ length: 25 }, (_, k) => first + ((last - first) * (k + 0.5)) / 25);
      const words = ["forward", "right", "down"];
      triads(pose, times, triad).forEach((data, k) => figure.traces.push(line(`body ${words[k]}`, `body_${"xyz"[k]}`, 3, data, true)));
    }
    const from = figure.traces.length;
    const colours = ["text", "body_x", "body_z"];
    airframe(start, size).forEach((data, k) => figure.traces.push(line(triad ? "airframe" : ["airframe", "forward", "down"][k], colours[k], k ? 5 : 4, data, !k || !triad)));

    const bar = document.createElement("div");
    bar.className = "pose";
    const slider = Object.assign(document.createElement("input"), { type: "range", min: first, max: last, step: "any", value: first });
    slider.setAttribute("aria-label", "time of the airframe shown");
    const readout = document.createElement("output");
    bar.append(slider, readout);
    div.after(bar);
    await H.draw(div);

    let wanted = null, busy = false;
    const move = async () => {
      busy = true;
      while (wanted !== null) {
        const t = wanted;
        wanted = null;
        const at = poseAt(pose, t);
        slider.value = String(t);
        const place = at && pose.position ? ` · north ${at.ned[0].toFixed(1)} m, east ${at.ned[1].toFixed(1)} m, height ${(-at.ned[2]).toFixed(1)} m` : "";
        readout.textContent = at
          ? `t = ${t.toFixed(2)} s · roll ${at.angles[0].toFixed(1)}°, pitch ${at.angles[1].toFixed(1)}°, yaw ${at.angles[2].toFixed(1)}°${place}`
          : `t = ${t.toFixed(2)} s: no solution`;
        if (!at) continue;
        const parts = airframe(at, size);
        const update = Object.fromEntries(["x", "y", "z"].map((c) => [c, parts.map((part) => part[c])]));
        await H.Plotly.restyle(div, update, parts.map((_, k) => from + k));
      }
      busy = false;
    };
    H.pose = (t) => {
      if (!H.nearby(div, 0)) return undefined;
      wanted = Math.min(Math.max(t, first), last);
      return busy ? undefined : move().catch(H.fail);
    };
    slider.addEventListener("input", () => { wanted = Number(slider.value); if (!busy) move().catch(H.fail); });
    wanted = first;
    await move();
    H.root.dataset.view = "drawn";
  };

  // Drawn when it comes into view: opening the page does not wait for it.
  H.startView = (div) => {
    H.root.dataset.view = "waiting";
    const watcher = new IntersectionObserver((entries) => {
      if (!entries.some((e) => e.isIntersecting)) return;
      watcher.disconnect();
      if (!webgl()) {
        div.textContent = "This view needs WebGL, which this browser does not offer here; the map and the plots above show the same data.";
        div.classList.add("without");
        div.style.height = "";
        H.root.dataset.view = "needs WebGL";
        return;
      }
      open(div).catch(H.fail);
    }, { rootMargin: "100px" });
    watcher.observe(div);
  };
})();
