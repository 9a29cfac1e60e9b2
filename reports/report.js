"use strict";
// Draws the charts and the layer views from the JSON beside it. No requests, no libraries.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const $ = (id) => document.getElementById(id);
  const label = Object.fromEntries(data.channels.map((c) => [c.name, c.label]));
  const names = data.channels.map((c) => c.name);
  const fixed = (v) => (v === null || v === undefined ? "–"
    : v >= 100 ? v.toFixed(0) : v >= 10 ? v.toFixed(1) : v.toFixed(2));
  const clock = (s) => {
    const h = Math.floor(s / 3600), m = Math.floor(s / 60) % 60, r = Math.floor(s % 60);
    const two = (n) => String(n).padStart(2, "0");
    return h ? h + ":" + two(m) + ":" + two(r) : m + ":" + two(r);
  };

  // ---- line charts ------------------------------------------------------------------------
  const SVG = "http://www.w3.org/2000/svg";
  function node(parent, tag, attributes, text) {
    const made = document.createElementNS(SVG, tag);
    for (const key in attributes) made.setAttribute(key, attributes[key]);
    if (text !== undefined) made.textContent = text;
    parent.append(made);
    return made;
  }
  function roundStep(span, count) {
    const raw = span / count, power = 10 ** Math.floor(Math.log10(raw));
    return power * [1, 2, 5, 10].find((f) => f * power >= raw);
  }
  function timeStep(span, count) {
    return [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800]
      .find((step) => span / step <= count) || 86400;
  }

  // `chart`: {name: of x, series: {name: values}, at: i -> x, text: i -> readout head,
  // tick: x -> text, step}
  function lineChart(box, readout, chart) {
    const shown = names.filter((name) => chart.series[name]);
    const count = Math.max(...shown.map((name) => chart.series[name].length));
    const peak = Math.max(1e-3, ...shown.map((name) =>
      chart.series[name].reduce((a, v) => (v !== null && v > a ? v : a), 0)));
    const resting = readout.textContent = "Point at the curve, or tap it, to read it.";
    function draw() {
      box.replaceChildren();
      const width = box.clientWidth, height = Math.min(260, Math.max(180, width * .3));
      const left = 44, right = 12, bottom = 44;
      const svg = node(box, "svg", { viewBox: `0 0 ${width} ${height}`, height });
      let legend = width - right;
      for (const name of [...shown].reverse()) {
        const text = node(svg, "text", { x: legend, y: 12, "text-anchor": "end" }, label[name]);
        legend -= text.getComputedTextLength() + 8;
        node(svg, "path", { class: name, d: `M${legend - 14} 8h14` });
        legend -= 28;
      }
      const unit = legend > 50 ? 12 : 30; // below the legend where there is no room beside it
      node(svg, "text", { x: 0, y: unit }, "µm rms");
      node(svg, "text", { x: (left + width - right) / 2, y: height - 6, "text-anchor": "middle" }, chart.name);
      const top = unit + 14;
      const x0 = chart.at(0), span = (chart.at(count - 1) - x0) || 1;
      const x = (i) => left + (chart.at(i) - x0) / span * (width - left - right);
      const step = roundStep(peak, 4), ceiling = Math.ceil(peak / step) * step;
      const y = (v) => top + (1 - v / ceiling) * (height - top - bottom);
      for (let v = 0; v <= ceiling * 1.0001; v += step) {
        node(svg, "line", { class: "grid", x1: left, x2: width - right, y1: y(v), y2: y(v) });
        node(svg, "text", { x: left - 6, y: y(v) + 4, "text-anchor": "end" }, String(+v.toFixed(6)));
      }
      const xStep = chart.step(span, Math.max(2, Math.floor((width - left) / 90)));
      for (let v = Math.ceil(x0 / xStep) * xStep; v <= x0 + span; v += xStep) {
        const at = left + (v - x0) / span * (width - left - right);
        node(svg, "text", { x: at, y: height - 26,
          "text-anchor": at > width - 30 ? "end" : "middle" }, chart.tick(v));
      }
      for (const name of shown) {
        let d = "", pen = "M";
        chart.series[name].forEach((v, i) => {
          if (v === null) { pen = "M"; return; }
          d += pen + x(i).toFixed(1) + " " + y(v).toFixed(1);
          pen = "L";
        });
        node(svg, "path", { class: name, d });
      }
      const cursor = node(svg, "line", { class: "cursor", y1: top, y2: height - bottom,
        visibility: "hidden" });
      svg.addEventListener("pointermove", (event) => {
        const at = (event.clientX - svg.getBoundingClientRect().left - left)
          / (width - left - right) * span + x0;
        let best = 0;
        for (let i = 1; i < count; i++) {
          if (Math.abs(chart.at(i) - at) < Math.abs(chart.at(best) - at)) best = i;
        }
        cursor.setAttribute("x1", x(best)); cursor.setAttribute("x2", x(best));
        cursor.setAttribute("visibility", "visible");
        readout.textContent = chart.text(best) + ": " + shown.map((name) =>
          label[name] + " " + fixed(chart.series[name][best]) + " µm").join(", ");
      });
      svg.addEventListener("pointerleave", () => {
        cursor.setAttribute("visibility", "hidden");
        readout.textContent = resting;
      });
    }
    return draw;
  }

  const redraws = [];
  const track = data.track.values;
  const longest = Math.max(0, ...names.map((name) => (track[name] || []).length));
  if (longest > 1) {
    $("track-section").hidden = false;
    redraws.push(lineChart($("track"), $("track-readout"), {
      name: `print time, ${data.track.bin_s * longest < 3600 ? "min:s" : "h:min:s"}`,
      series: track, at: (i) => i * data.track.bin_s, tick: clock, step: timeStep,
      text: (i) => "At " + clock(i * data.track.bin_s) }));
  }
  if (data.layers.length > 1) {
    $("bylayer-section").hidden = false;
    const series = {};
    for (const name of names) {
      if (data.layers.some((layer) => name in layer.values)) {
        series[name] = data.layers.map((layer) => layer.values[name] ?? null);
      }
    }
    redraws.push(lineChart($("bylayer"), $("bylayer-readout"), {
      name: "layer", series, at: (i) => i,
      tick: (v) => (data.layers[v].name.length < 6 ? data.layers[v].name : ""),
      step: (span, count) => Math.max(1, roundStep(span, count)),
      text: (i) => "Layer " + data.layers[i].name + ", " + clock(data.layers[i].seconds) }));
  }

  // ---- layer views ------------------------------------------------------------------------
  // Samples of matplotlib's "viridis" (CC0): even steps of lightness, readable without colour
  // vision. Small errors recede towards the ground, whichever ground it is.
  const VIRIDIS = ["#440154", "#481b6d", "#46327e", "#3f4788", "#365c8d", "#2e6e8e", "#277f8e",
    "#21918c", "#1fa187", "#2db27d", "#4ac16d", "#73d056", "#a0da39", "#d0e11c", "#fde725"];
  const STEPS = 48;
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  function viridis(t) {
    const at = t * (VIRIDIS.length - 1), i = Math.min(Math.floor(at), VIRIDIS.length - 2);
    const a = rgb(VIRIDIS[i]), b = rgb(VIRIDIS[i + 1]);
    return "rgb(" + a.map((v, k) => Math.round(v + (b[k] - v) * (at - i))).join(",") + ")";
  }
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  const isDark = () => scheme.matches && !printing;
  const colour = (t) => viridis(isDark() ? .24 + .76 * t : .80 - .80 * t);
  const views = data.views;

  function layerViews() {
    $("layers-section").hidden = false;
    const slider = $("layer"), left = $("left"), right = $("right");
    const choices = names.filter((name) => name !== "before");
    let shown = choices.includes("after") ? "after" : choices[0];
    slider.max = views.length - 1;
    slider.value = Math.floor((views.length - 1) / 2);
    slider.disabled = views.length < 2;
    let box = [Infinity, Infinity, -Infinity, -Infinity];
    for (const view of views) {
      for (let i = 0; i < view.x.length; i++) {
        if (view.on[i] !== "1") continue;
        box = [Math.min(box[0], view.x[i]), Math.min(box[1], view.y[i]),
          Math.max(box[2], view.x[i]), Math.max(box[3], view.y[i])];
      }
    }
    if (!(box[2] >= box[0])) box = [0, 0, 1, 1];
    const wide = Math.max(box[2] - box[0], 1), tall = Math.max(box[3] - box[1], 1);
    const PAD = 14;
    const place = (canvas) => {
      const width = canvas.clientWidth, height = canvas.clientHeight;
      const scale = Math.min((width - 2 * PAD) / wide, (height - 2 * PAD) / tall);
      const dx = (width - scale * wide) / 2, dy = (height - scale * tall) / 2;
      return { x: (v) => dx + (v - box[0]) * scale, y: (v) => height - dy - (v - box[1]) * scale,
        scale };
    };
    function paint(canvas, view, name) {
      const width = canvas.parentElement.clientWidth;
      const height = Math.round(Math.min(Math.max(width * Math.min(tall / wide, 1.1), 200), 560));
      const dots = window.devicePixelRatio || 1;
      canvas.style.aspectRatio = width + " / " + height;  // on paper it becomes narrower
      canvas.width = width * dots; canvas.height = height * dots;
      const pen = canvas.getContext("2d"), to = place(canvas), error = view.error[name] || [];
      pen.scale(dots, dots);
      pen.lineCap = "round";
      pen.lineWidth = Math.max(1, Math.min(3, .42 * to.scale));
      const buckets = Array.from({ length: STEPS }, () => []);
      for (let i = 1; i < view.x.length; i++) {
        if (view.on[i] !== "1") continue;
        const level = Math.min((error[i] ?? 0) / data.scale_um, 1);
        buckets[Math.min(Math.floor(level * STEPS), STEPS - 1)].push(i);
      }
      buckets.forEach((bucket, k) => {  // large errors last, so that they are on top
        if (!bucket.length) return;
        pen.strokeStyle = colour(k / (STEPS - 1));
        pen.beginPath();
        for (const i of bucket) {
          pen.moveTo(to.x(view.x[i - 1]), to.y(view.y[i - 1]));
          pen.lineTo(to.x(view.x[i]), to.y(view.y[i]));
        }
        pen.stroke();
      });
      canvas.setAttribute("aria-label",
        `Path of layer ${view.layer}, coloured by contour error: ${label[name]}`);
    }
    function legend() {
      const canvas = $("legend"), pen = canvas.getContext("2d");
      canvas.width = STEPS * 8; canvas.height = 8;
      for (let k = 0; k < STEPS; k++) {
        pen.fillStyle = colour(k / (STEPS - 1));
        pen.fillRect(k * 8, 0, 8, 8);
      }
      $("ticks").replaceChildren(...[0, .25, .5, .75, 1].map((t) => {
        const tick = document.createElement("span");
        tick.textContent = t === 1 ? "≥ " + data.scale_um + " µm" : +(t * data.scale_um).toFixed(3);
        return tick;
      }));
    }
    const resting = "Point at the path, or tap it, to read line and error. The arrow keys move the slider.";
    function draw() {
      const view = views[slider.value];
      $("layer-name").textContent = `${view.layer}, z ${view.z} mm`;
      slider.setAttribute("aria-valuetext", `layer ${view.layer}, z ${view.z} millimetres`);
      $("left-name").textContent = label.before || "before";
      $("right-name").textContent = label[shown];
      $("right-name").className = choices.length > 1 ? "paper" : "";  // the buttons say it
      paint(left, view, "before");
      if (shown) paint(right, view, shown);
      legend();
      hide();
    }
    const marks = [left, right].map((canvas) => canvas.parentElement.querySelector(".mark"));
    function hide() {
      marks.forEach((mark) => { mark.hidden = true; });
      $("view-readout").textContent = resting;
    }
    function point(event) {
      const view = views[slider.value], canvas = event.currentTarget, to = place(canvas);
      const frame = canvas.getBoundingClientRect();
      const px = event.clientX - frame.left, py = event.clientY - frame.top;
      let best = -1, nearest = 400;
      for (let i = 0; i < view.x.length; i++) {
        if (view.on[i] !== "1") continue;
        const d = (to.x(view.x[i]) - px) ** 2 + (to.y(view.y[i]) - py) ** 2;
        if (d < nearest) { nearest = d; best = i; }
      }
      if (best < 0) return hide();
      [left, right].forEach((other, k) => {
        const spot = place(other);
        marks[k].hidden = false;
        marks[k].style.left = spot.x(view.x[best]) + "px";
        marks[k].style.top = spot.y(view.y[best]) + "px";
      });
      $("view-readout").textContent = `Line ${view.line[best]}: ` + names
        .filter((name) => view.error[name])
        .map((name) => label[name] + " " + fixed(view.error[name][best]) + " µm").join(", ");
    }
    for (const canvas of [left, right]) {
      canvas.addEventListener("pointermove", point);
      canvas.addEventListener("pointerdown", point);
      canvas.addEventListener("pointerleave", hide);
    }
    slider.addEventListener("input", draw);
    if (!shown) right.closest("figure").hidden = true;
    if (choices.length > 1) {
      for (const name of choices) {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = label[name];
        button.setAttribute("aria-pressed", String(name === shown));
        button.addEventListener("click", () => {
          shown = name;
          for (const other of $("right-choice").children) {
            other.setAttribute("aria-pressed", String(other === button));
          }
          draw();
        });
        $("right-choice").append(button);
      }
    }
    return draw;
  }
  if (views.length) redraws.push(layerViews());

  // The service that sends this page has the documents, too; beside a file there are none.
  const service = /^https?:/.test(location.protocol)
    ? /^(.*\/)v1\/jobs\/[^/]+\/report$/.exec(location.pathname) : null;
  if (service) {
    const named = /\bdocs\/([\w/-]+)\.md\b/;
    for (const box of document.querySelectorAll("main p, main li, main td")) {
      for (const text of [...box.childNodes]) {
        if (text.nodeType !== Node.TEXT_NODE || !named.test(text.data)) continue;
        text.replaceWith(...text.data.split(named).map((part, k) => {
          if (k % 2 === 0) return part;
          const link = document.createElement("a");
          link.href = `${service[1]}help/${part}`;
          link.textContent = `docs/${part}.md`;
          return link;
        }));
      }
    }
  }

  const redraw = () => redraws.forEach((draw) => draw());
  redraw();
  let width = window.innerWidth;
  addEventListener("resize", () => {
    if (window.innerWidth !== width) { width = window.innerWidth; redraw(); }
  });
  scheme.addEventListener("change", redraw);
  addEventListener("beforeprint", () => { printing = true; redraw(); });
  addEventListener("afterprint", () => { printing = false; redraw(); });
})();
