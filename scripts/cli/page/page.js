// The page of `headway report`: plots over one time axis, and the animation that runs along it.
"use strict";

(() => {
  const page = JSON.parse(document.getElementById("data").textContent);
  const find = (id) => document.getElementById(id);

  // Numbers: base64 of little-endian floats. What is not a number is a gap.

  function bytes(text) {
    const raw = atob(text);
    const out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return out;
  }

  function numbers(text) {
    const values = new Float32Array(bytes(text).buffer);
    return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
  }

  function short(value) {
    if (value == null) return "-";
    const size = Math.abs(value);
    const digits = Number(value.toPrecision(4));
    if (size !== 0 && (size < 1e-3 || size >= 1e6)) return digits.toExponential();
    return String(digits);
  }

  // Colours: variables of page.css, other ones in the dark.

  const theme = matchMedia("(prefers-color-scheme: dark)");
  const colours = new Map();

  function colour(name) {
    if (!colours.has(name)) {
      const style = getComputedStyle(document.documentElement);
      colours.set(name, style.getPropertyValue("--" + name).trim());
    }
    return colours.get(name);
  }

  theme.addEventListener("change", () => {
    colours.clear();
    for (const plot of plots) plot.redraw(true, true);
  });

  // Plots. Those over time share their cursor and their zoom.

  const HEIGHT = 240; // [px]
  const TINT = "50"; // opacity of bands, in hexadecimal
  const plots = [];
  const timed = [];
  const marks = []; // where the animation is, in each of `timed`

  // What uPlot wants to know of a curve; a band has a series for each of its edges.
  function seriesOf(curve) {
    const own = () => colour(curve.colour);
    const line = {
      label: curve.label,
      key: own, // its colour in the legend
      stroke: own,
      width: 1.2,
      points: { show: false },
      value: (plot, value) => short(value),
    };
    switch (curve.style) {
      case "band": {
        const value = (plot, low, index, at) =>
          low == null ? "-" : short(low) + " to " + short(plot.data[index + 1][at]);
        const edge = { ...line, key: () => own() + TINT, width: 0, stroke: null };
        return [
          { ...edge, value },
          { ...edge, class: "edge" },
        ];
      }
      case "dashed":
        return [{ ...line, width: 1.5, dash: [6, 4] }];
      case "steps":
        return [{ ...line, width: 1.5, paths: uPlot.paths.stepped({ align: 1 }) }];
      case "dots":
        return [
          { ...line, paths: () => null, points: { show: true, size: 4, width: 0, fill: own } },
        ];
      case "bars":
        return [
          { ...line, width: 0, fill: () => own() + "a0", paths: uPlot.paths.bars({ size: [0.9] }) },
        ];
      default:
        return [line];
    }
  }

  // The x of all curves and their values there: undefined where a curve has none at that x.
  function dataOf(content) {
    const known = (value) => (content.log && value <= 0 ? null : value);
    const column = (text) => numbers(text).map(known);
    const tables = content.groups.map((group) => [
      numbers(group.x),
      ...group.curves.flatMap((curve) => curve.values.map(column)),
    ]);
    return tables.length > 1 ? uPlot.join(tables) : tables[0];
  }

  // The place nearest to `at` where a series has a value of its own, or a gap.
  function nearest(values, at) {
    for (let off = 0; at - off >= 0 || at + off < values.length; off++) {
      if (values[at - off] !== undefined) return at - off;
      if (values[at + off] !== undefined) return at + off;
    }
    return at;
  }

  // Least and greatest value in view; if it is a judged plot, of the judged span.
  function extremes(plot, content) {
    const [first, last] = plot.series[0].idxs;
    const [begin, end] = content.judged ? page.span : [-Infinity, Infinity];
    const x = plot.data[0];
    let low = Infinity;
    let high = -Infinity;
    for (let s = 1; s < plot.data.length; s++) {
      if (!plot.series[s].show) continue;
      for (let i = first; i <= last; i++) {
        const y = plot.data[s][i];
        if (y == null || x[i] < begin || x[i] > end) continue;
        if (y < low) low = y;
        if (y > high) high = y;
      }
    }
    return [low, high];
  }

  function yRange(content) {
    return (plot, dataLow, dataHigh) => {
      let [low, high] = extremes(plot, content);
      if (low > high) [low, high] = [dataLow, dataHigh]; // nothing judged is in view
      if (low == null) [low, high] = content.log ? [0.1, 10] : [0, 1];
      for (const level of content.upright ? [] : content.levels) {
        if (!level.reached) continue;
        low = Math.min(low, level.value);
        high = Math.max(high, level.value);
      }
      if (content.log) return uPlot.rangeLog(low, high, 10, true);
      const room = 0.06 * (high - low || Math.abs(high) || 1);
      return [low < 0 || low > high / 3 ? low - room : 0, high > 0 ? high + room : 0];
    };
  }

  // The times that are not judged: the entry, and the coasting to rest.
  function shade(plot) {
    const { ctx, bbox } = plot;
    const [begin, end] = page.span;
    const at = (x) =>
      Math.min(Math.max(plot.valToPos(x, "x", true), bbox.left), bbox.left + bbox.width);
    ctx.save();
    ctx.fillStyle = colour("shade");
    ctx.fillRect(bbox.left, bbox.top, at(begin) - bbox.left, bbox.height);
    ctx.fillRect(at(end), bbox.top, bbox.left + bbox.width - at(end), bbox.height);
    ctx.fillStyle = colour("level");
    ctx.font = 11 * devicePixelRatio + "px sans-serif";
    ctx.textBaseline = "bottom";
    const write = (text, left, right) => {
      if (ctx.measureText(text).width + 8 > right - left) return;
      ctx.textAlign = "center";
      ctx.fillText(text, (left + right) / 2, bbox.top + bbox.height - 3);
    };
    write("entry", bbox.left, at(begin));
    write("to rest", at(end), bbox.left + bbox.width);
    ctx.restore();
  }

  function drawLevels(content) {
    return (plot) => {
      const { ctx, bbox } = plot;
      const [right, bottom] = [bbox.left + bbox.width, bbox.top + bbox.height];
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      ctx.strokeStyle = colour("bad");
      ctx.fillStyle = colour("bad");
      ctx.lineWidth = devicePixelRatio;
      ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
      ctx.font = 11 * devicePixelRatio + "px sans-serif";
      const write = (text, x, y) => {
        ctx.save();
        ctx.setLineDash([]);
        ctx.strokeStyle = colour("card"); // so that curves behind do not cover it
        ctx.lineWidth = 3 * devicePixelRatio;
        ctx.strokeText(text, x, y);
        ctx.restore();
        ctx.fillText(text, x, y);
      };
      for (const [i, level] of content.levels.entries()) {
        const at = plot.valToPos(level.value, content.upright ? "x" : "y", true);
        ctx.beginPath();
        if (content.upright) {
          ctx.moveTo(at, bbox.top);
          ctx.lineTo(at, bottom);
          const before = at > bbox.left + 0.75 * bbox.width;
          ctx.textAlign = before ? "right" : "left";
          write(level.label, at + (before ? -4 : 4), bbox.top + (12 + 14 * i) * devicePixelRatio);
        } else {
          ctx.moveTo(bbox.left, at);
          ctx.lineTo(right, at);
          const onLeft = i % 2 === 1; // so that labels of close levels do not cover each other
          ctx.textAlign = onLeft ? "left" : "right";
          const below = at - bbox.top < 16 * devicePixelRatio;
          const y = at + (below ? 13 : -4) * devicePixelRatio;
          write(level.label, onLeft ? bbox.left + 4 : right - 4, y);
        }
        ctx.stroke();
      }
      ctx.restore();
    };
  }

  function axis(label, size, log) {
    const power = (plot, values) => values.map((value) => (value == null ? "" : short(value)));
    return {
      ...(log && { values: power }),
      label,
      size,
      labelSize: 18,
      labelGap: 0,
      gap: 4,
      stroke: () => colour("faint"),
      font: "11px sans-serif",
      labelFont: "12px sans-serif",
      grid: { stroke: () => colour("grid"), width: 1 },
      ticks: { stroke: () => colour("grid"), width: 1, size: 5 },
    };
  }

  function draw(content, place) {
    const curves = content.groups.flatMap((group) => group.curves);
    const series = [
      { label: content.time ? "time [s]" : content.x, value: (plot, value) => short(value) },
    ];
    const bands = [];
    for (const curve of curves) {
      series.push(...seriesOf(curve));
      if (curve.style !== "band") continue;
      const fill = () => colour(curve.colour) + TINT;
      bands.push({ series: [series.length - 1, series.length - 2], fill });
    }
    const options = {
      width: place.clientWidth,
      height: HEIGHT,
      series,
      bands,
      scales: {
        x: { time: false },
        y: { distr: content.log ? 3 : 1, range: yRange(content) },
      },
      axes: [axis(content.x, 30), axis(content.y, 48, content.log)],
      legend: {
        markers: { width: 0, fill: (plot, index) => plot.series[index].key?.() },
      },
      cursor: {
        dataIdx: (plot, index, at) => (index === 0 ? at : nearest(plot.data[index], at)),
        points: { size: 5, width: 0 },
      },
      hooks: { drawClear: [], draw: [drawLevels(content)] },
    };
    if (content.time) {
      options.cursor.sync = { key: "time", setSeries: false, scales: ["x", null] };
      options.cursor.sync.filters = {
        pub: (kind) => kind === "mousemove" || kind === "mouseleave",
      };
      options.cursor.bind = { dblclick: () => () => zoom(...page.whole) };
      options.scales.x.range = (plot, low, high) => [low, high];
      options.hooks.drawClear.push(shade);
      options.hooks.setScale = [(plot, scale) => scale === "x" && follow(plot)];
      options.hooks.setSize = [() => placeMarks()];
    }
    const plot = new uPlot(options, dataOf(content), place);
    plots.push(plot);
    if (!content.time) return;
    timed.push(plot);
    const mark = document.createElement("div");
    mark.className = "mark";
    plot.over.append(mark);
    marks.push(mark);
    seekOnClick(plot);
  }

  // Zooming one plot zooms all.

  let zooming = false;

  function zoom(low, high) {
    zooming = true;
    for (const plot of timed) plot.setScale("x", { min: low, max: high });
    zooming = false;
    find("whole").hidden = low <= page.whole[0] && high >= page.whole[1];
    requestAnimationFrame(placeMarks);
  }

  function follow(plot) {
    const { min, max } = plot.scales.x;
    if (!zooming && timed.includes(plot)) zoom(min, max);
  }

  // The animation: pictures at equal distances in time.

  const film = page.film;
  const last = film && film.pictures.length - 1;
  const end = film && film.start + last / film.fps;
  let time = film ? film.start : 0;

  function placeMarks() {
    timed.forEach((plot, i) => {
      const at = plot.valToPos(time, "x");
      marks[i].hidden = !film || !(at >= 0 && at <= plot.over.clientWidth);
      marks[i].style.transform = "translateX(" + at.toFixed(1) + "px)";
    });
  }

  // A click in a plot, but not the end of a drag, which zooms, takes the animation there.
  function seekOnClick(plot) {
    let from = 0;
    plot.over.addEventListener("pointerdown", (event) => (from = event.clientX));
    plot.over.addEventListener("click", (event) => {
      if (!film || Math.abs(event.clientX - from) > 3) return;
      play(false);
      seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    });
  }

  const KEPT = 60; // decoded pictures
  const decoded = new Map();

  function picture(index) {
    if (!decoded.has(index)) {
      const blob = new Blob([bytes(film.pictures[index])], { type: "image/webp" });
      decoded.set(index, createImageBitmap(blob));
      if (decoded.size > KEPT) decoded.delete(decoded.keys().next().value);
    }
    return decoded.get(index);
  }

  let wanted = -1;

  async function show(index) {
    if (index === wanted) return;
    wanted = index;
    const bitmap = await picture(index);
    if (index !== wanted) return; // it came too late
    const canvas = find("film");
    canvas.getContext("2d").drawImage(bitmap, 0, 0, canvas.width, canvas.height);
    canvas.dataset.shown = index;
  }

  function seek(to) {
    time = Math.min(Math.max(to, film.start), end);
    show(Math.round((time - film.start) * film.fps));
    find("time").value = time;
    find("clock").value = time.toFixed(2) + " s";
    placeMarks();
  }

  let playing = false;
  let before = 0;

  function play(on) {
    find("play").textContent = on ? "Pause" : "Play";
    if (on && !playing) requestAnimationFrame(begin);
    playing = on;
  }

  function begin(now) {
    before = now;
    requestAnimationFrame(step);
  }

  function step(now) {
    if (!playing) return;
    const next = time + ((now - before) / 1000) * Number(find("speed").value);
    before = now;
    seek(next <= end ? next : film.start);
    requestAnimationFrame(step);
  }

  function startFilm() {
    find("play").addEventListener("click", () => play(!playing));
    find("time").addEventListener("input", (event) => {
      play(false);
      seek(Number(event.target.value));
    });
    seek(film.start);
    play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  }

  // Everything at its place.

  document.querySelectorAll("[data-plot]").forEach((place) => {
    draw(page.plots[place.dataset.plot], place);
  });
  const resized = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      const plot = plots[target.dataset.plot];
      const width = target.clientWidth;
      if (plot.width !== width) plot.setSize({ width, height: HEIGHT });
    }
  });
  document.querySelectorAll("[data-plot]").forEach((place) => resized.observe(place));
  zoom(...page.whole);
  find("whole").addEventListener("click", () => zoom(...page.whole));
  if (film) startFilm();
  document.documentElement.dataset.ready = plots.length;
})();
