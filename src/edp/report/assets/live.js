"use strict";
(() => {
  const session = JSON.parse(document.getElementById("session").textContent);
  const element = (id) => document.getElementById(id);
  const [play, scrub, clock, nowButton, notice] = ["play", "scrub", "clock", "now", "notice"].map(element);
  const MOST_BYTES = 32 << 20, SHOWN = 6, PAST_S = 12;
  const stats = { lags: [], frames: 0, ticks: 0, dropped: 0, gaps: 0 };
  window.edpLive = stats; // what benchmarks and tests read
  let layout = null, store = null, charts = null, side = null, steered = false, socket = null, ended = "", asked = -1;
  let following = true, position = 0, playing = true, dirty = false, drawn = 0, stamp = 0, arrived = 0, retry = 500, closed = false;
  let state = { paused: false, skipped: 0, late: false, preparing: "", oldest: 0, viewers: 1 };
  let breaks = session.breaks || [];
  const chosen = new Set(), groups = new Map();

  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  let palette = null, paletteOf = null;
  function colours() {
    // By what it is of, not by the event of a change, which comes before the styles are new.
    if (palette && paletteOf === dark.matches) return palette;
    paletteOf = dark.matches;
    const style = getComputedStyle(document.documentElement), value = (name) => style.getPropertyValue(`--${name}`).trim();
    palette = Object.fromEntries(["ink", "soft", "grid", "measured", "blue", "band", "rest", "bad"].map((name) => [name, value(name)]));
    return palette;
  }
  dark.addEventListener("change", () => { palette = null; dirty = true; });

  /* Whether the session began anew after a tick and up to another: what was foretold before says nothing of it. */
  function parted(from, to) {
    for (let k = breaks.length - 1; k >= 0 && breaks[k] > from; k--) if (breaks[k] <= to) return true;
    return false;
  }
  /* What a forecast said of a tick: it was made `ticks` before. */
  const foretold = (forecast, column) => (tick) => (
    parted(tick - forecast.ticks, tick) ? NaN : store.at(tick - forecast.ticks, column) * forecast.factor + forecast.offset
  );
  const measured = (column, factor, offset = 0) => (tick) => store.at(tick, column) * factor + offset;

  function forecastPlots(horizon) {
    const plots = [];
    layout.forecasts.filter((one) => one.ticks === horizon || one.model !== "network").forEach((one) => {
      const id = `${one.model}|${one.name}`, ahead = one.ticks ? `${+(one.ticks / layout.rate_hz).toFixed(4)} s ahead` : "at once";
      const lines = [{ name: one.model === "network" ? `predicted ${ahead}` : one.model, values: foretold(one, one.column), colour: "blue", dashed: true }];
      if (one.lower !== null) {
        lines.push({ name: "upper", bound: "upper", values: foretold(one, one.upper) }, { name: "lower", bound: "lower", values: foretold(one, one.lower) });
      }
      if (one.measured !== null) lines.unshift({ name: "measured", values: measured(one.measured, one.factor, one.offset), colour: "measured" });
      const interval = one.lower === null ? "" : `, ${Math.round(100 * one.coverage)} % interval`;
      plots.push({ id: `${id}|${one.ticks}`, choice: id, title: `${one.name}${interval}`, unit: one.unit, lines });
      if (one.measured !== null) {
        const actual = measured(one.measured, one.factor, one.offset), said = foretold(one, one.column);
        plots.push({
          id: `${id}|${one.ticks}|rest`, choice: id, title: `${one.name}: measured less ${one.model === "network" ? "predicted" : one.model}`, unit: one.unit, height: 90,
          lines: [{ name: "residual", values: (tick) => actual(tick) - said(tick), colour: "rest" }],
        });
      }
    });
    return plots;
  }
  function plots() {
    const specs = [];
    if (layout.statistics.length) {
      specs.push({
        id: "watch", choice: "watch", title: "Monitor: statistic over its limit", unit: "1", height: 110,
        lines: [...layout.statistics.map((one, k) => ({ name: one.name, values: measured(one.column, 1), colour: ["blue", "rest", "soft"][k % 3] })),
          { name: "alarm above", values: () => 1, colour: "bad", dashed: true }],
      });
    }
    specs.push(...forecastPlots(Number(element("horizon").value)));
    layout.traces.forEach((one, column) => specs.push({
      id: `trace|${column}`, choice: `trace|${column}`, title: one.name, unit: one.unit,
      lines: [{ name: "measured", values: measured(column, one.factor, one.offset), colour: "measured" }],
    }));
    return specs;
  }
  function choose() {
    charts.show(plots().filter((spec) => chosen.has(spec.choice)));
    dirty = true;
  }
  function boxes() {
    const box = element("boxes"), names = new Map();
    plots().forEach((spec) => { if (!names.has(spec.choice)) names.set(spec.choice, spec); });
    box.replaceChildren();
    const first = [...names.keys()];
    if (!chosen.size) {
      // Predictions show what is measured, too; raw channels stand first only where nothing is predicted.
      const wanted = layout.forecasts.length ? first.filter((name) => !name.startsWith("trace|")) : first;
      wanted.slice(0, layout.statistics.length ? SHOWN + 1 : SHOWN).forEach((name) => chosen.add(name));
    }
    first.forEach((name) => {
      const label = document.createElement("label"), input = document.createElement("input");
      input.type = "checkbox"; input.checked = chosen.has(name);
      input.addEventListener("change", () => { (input.checked ? chosen.add(name) : chosen.delete(name)); choose(); });
      const spec = names.get(name);
      label.append(input, name.startsWith("trace|") || name === "watch" ? spec.title : `${spec.title} (${name.split("|")[0]})`);
      box.append(label);
    });
  }
  function begin(plain, canSteer) {
    layout = plain; steered = canSteer;
    store = edpStore(layout.width, MOST_BYTES);
    element("title").textContent = layout.title;
    element("source").textContent = layout.source;
    const horizons = [...new Set(layout.forecasts.filter((one) => one.model === "network").map((one) => one.ticks))];
    element("horizon").replaceChildren(...horizons.map((ticks) => {
      const option = document.createElement("option");
      option.value = ticks; option.textContent = `${+(ticks / layout.rate_hz).toFixed(4)} s`;
      return option;
    }));
    if (horizons.length) element("horizon").value = Math.max(...horizons);
    element("horizon-label").hidden = horizons.length < 2;
    element("speed-label").hidden = !steered && session.mode === "live";
    element("save").hidden = session.mode !== "live";
    element("watch").textContent = layout.statistics.length ? "Alarms are the monitor's." : "No monitor watches (--monitor): residuals are shown, and nothing is called an alarm.";
    side = layout.geometry ? edpSideView(layout.geometry) : null;
    element("front").hidden = !side;
    element("events").replaceChildren(); groups.clear();
    if (charts) charts.show([]);
    charts = edpCharts(element("charts"), colours, () => { dirty = true; });
    leversOf(); boxes(); choose();
  }

  let bars = [];
  function leversOf() {
    const list = element("levers");
    list.replaceChildren();
    element("levers-title").hidden = !layout.levers.length;
    bars = layout.levers.map((column) => {
      const trace = layout.traces[column], row = document.createElement("div"), term = document.createElement("dt");
      const bar = document.createElement("dd"), value = document.createElement("dd"), meter = document.createElement("meter");
      term.textContent = trace.description || trace.name; term.title = trace.name;
      meter.min = 0; meter.max = 1; meter.setAttribute("aria-label", trace.name);
      bar.append(meter); row.append(term, bar, value); list.append(row);
      return { column, trace, meter, value, most: 1e-9 };
    });
  }
  function drawLevers(tick) {
    bars.forEach((bar) => {
      const v = store.at(tick, bar.column) * bar.trace.factor + bar.trace.offset;
      if (v === v) bar.most = Math.max(bar.most, Math.abs(v));
      bar.meter.value = v === v ? Math.abs(v) / bar.most : 0;
      bar.value.textContent = v === v ? `${v.toFixed(1)} ${bar.trace.unit === "1" ? "" : bar.trace.unit}` : "–";
    });
  }

  const atText = (tick) => `${(tick / layout.rate_hz).toFixed(1)} s`;
  function addEvent(event) {
    const known = event.group ? groups.get(event.group) : null;
    if (known) { // a fault that stays alarms again: one row tells it
      known.count += 1;
      known.again.textContent = ` (${known.count} times, last at ${atText(event.tick)})`;
      return;
    }
    const row = document.createElement("li"), when = document.createElement("time"), text = document.createElement("span"), again = document.createElement("span");
    row.className = event.kind; when.textContent = atText(event.tick); text.textContent = event.text;
    text.append(again); row.append(when, text);
    if (event.group) groups.set(event.group, { count: 1, again });
    const list = element("events");
    list.prepend(row);
    while (list.children.length > 300) list.lastChild.remove();
  }

  const newest = () => Math.max(0, store.end - 1);
  const shownTick = () => (following ? newest() : Math.round(position));
  function draw() {
    const rate = layout.rate_hz, tick = shownTick(), wide = Number(element("window").value) * rate;
    const ahead = Math.max(0, ...layout.forecasts.map((one) => one.ticks));
    const first = Math.max(0, tick - wide);
    if (!store.has(first, tick) && session.mode === "live") ask(first);
    charts.draw(first, Math.max(tick + Math.min(ahead, 0.25 * wide), first + rate), tick, rate);
    if (side && layout.angles.length) {
      const angles = layout.angles.map((column) => store.at(tick, column));
      if (angles.every((value) => value === value)) {
        const path = [];
        for (let k = Math.max(0, tick - PAST_S * rate); k <= tick; k += Math.max(1, Math.round(rate / 20))) {
          const then = layout.angles.map((column) => store.at(k, column));
          if (!then.every((value) => value === value)) continue;
          const tip = side.pose(then).tip, last = path[path.length - 1];
          // A new session begins elsewhere: no bucket flew there.
          if (last && Math.hypot(tip[0] - last[0], tip[1] - last[1]) > 0.1 * side.reach) path.length = 0;
          path.push(tip);
        }
        side.draw(element("front"), { angles, path });
      }
    }
    drawLevers(tick);
    scrub.max = steered && layout.ticks ? layout.ticks - 1 : newest();
    scrub.min = state.oldest || 0;
    if (document.activeElement !== scrub || following) scrub.value = tick;
    clock.textContent = `${atText(tick)} of ${atText(Number(scrub.max))}`;
    nowButton.hidden = following || session.mode !== "live";
    stats.frames += 1;
    if (following && stamp) {
      stats.lags.push(Date.now() - 1000 * stamp); stamp = 0;
      if (stats.lags.length > 5000) stats.lags.shift();
    }
  }
  function ask(first) {
    const from = Math.max(0, Math.round(first));
    if (!socket || socket.readyState !== 1 || from === asked) return;
    asked = from;
    socket.send(JSON.stringify({ do: "past", first: from, count: Math.round(70 * layout.rate_hz) }));
  }

  function words() {
    const parts = [];
    if (session.mode === "saved") parts.push(`saved session: ${session.count} of ${session.all} ticks`);
    else if (closed) parts.push(ended || "the session has ended: the server is gone");
    else if (!socket || socket.readyState !== 1) parts.push("connecting");
    else if (ended) parts.push(ended);
    else if (state.paused) parts.push("source paused");
    else if (arrived && Date.now() - arrived > 1500) parts.push(`no new values for ${Math.round((Date.now() - arrived) / 1000)} s`);
    else if (!store.end) parts.push(state.preparing || "waiting for the first values");
    else parts.push(following ? "live" : "looking back");
    const lags = stats.lags.slice(-100).sort((a, b) => a - b);
    parts.push(`${layout.rate_hz} Hz`, `${layout.traces.length} channels`);
    if (lags.length && ["127.0.0.1", "localhost"].includes(location.hostname)) parts.push(`lag ${Math.round(lags[lags.length >> 1])} ms`);
    element("state").textContent = parts.join(" · ");
    const told = [];
    if (stats.dropped) told.push(`this page was too slow: ${stats.dropped} ticks were not sent to it (the source lost none)`);
    if (state.skipped) told.push(`${state.skipped} ticks of running ahead were sent to nobody`);
    if (state.late && !ended) told.push(`the source is behind real time${layout.forecasts.length || layout.statistics.length ? ": its models take longer" : ""}`);
    notice.textContent = told.join("; "); notice.hidden = !told.length;
    const paused = session.mode === "saved" ? !playing : steered ? state.paused : !following;
    play.textContent = paused ? (session.mode === "saved" || steered ? "Play" : "Back to now") : "Pause";
    if (!steered && session.mode === "live") nowButton.hidden = true;
  }

  function receive(data) {
    if (typeof data !== "string") {
      const message = edpRows(data);
      if (message.kind === 1) {
        if (store.end && message.first > store.end) stats.gaps += 1;
        store.push(message.first, message.count, message.rows);
        stats.ticks += message.count; stamp = message.stamp; arrived = Date.now();
      } else store.look(message.first, message.count, message.rows);
      dirty = true;
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "layout") begin(message.layout, message.steered);
    if (message.type === "event") addEvent(message.event);
    if (message.type === "dropped") stats.dropped = message.ticks;
    if (message.type === "state") {
      state = message; ended = message.ended; breaks = message.breaks; stats.state = message;
      if (message.speed && document.activeElement !== element("speed")) element("speed").value = String(message.speed);
    }
    if (message.type === "closed") { closed = true; }
    if (layout) words();
  }
  function connect() {
    socket = new WebSocket(`ws://${location.host}${location.pathname.replace(/[^/]*$/, "")}socket`);
    socket.binaryType = "arraybuffer";
    socket.addEventListener("open", () => { retry = 500; });
    socket.addEventListener("message", (event) => receive(event.data));
    socket.addEventListener("close", () => {
      if (layout) words();
      if (closed) return;
      retry = Math.min(2 * retry, 10000);
      window.setTimeout(connect, retry);
    });
  }
  const send = (what) => { if (socket && socket.readyState === 1) socket.send(JSON.stringify(what)); };

  play.addEventListener("click", () => {
    if (session.mode === "saved") {
      if (!playing && position >= newest()) position = store.first;
      playing = !playing;
    } else if (steered) { following = true; send({ do: "pause", value: state.paused ? 0 : 1 }); }
    else { position = newest(); following = !following; }
    dirty = true; words();
  });
  nowButton.addEventListener("click", () => { following = true; dirty = true; words(); });
  function seek(tick) {
    const to = Math.max(Number(scrub.min), Math.min(tick, Number(scrub.max)));
    if (session.mode === "live" && to > newest()) { following = true; send({ do: "ahead", tick: to }); }
    else { following = session.mode === "live" && to >= newest(); position = to; }
    dirty = true; words();
  }
  scrub.addEventListener("input", () => seek(Number(scrub.value)));
  element("speed").addEventListener("change", () => send({ do: "speed", value: Number(element("speed").value) }));
  ["window", "horizon"].forEach((id) => element(id).addEventListener("change", () => choose()));
  document.addEventListener("keydown", (event) => {
    if (!layout || event.target.matches("input, select, button, summary, a")) return;
    if (event.key === " ") { event.preventDefault(); play.click(); }
    if (event.key === "ArrowRight" || event.key === "ArrowLeft") seek(shownTick() + (event.key === "ArrowRight" ? 1 : -1) * layout.rate_hz);
  });
  window.addEventListener("resize", () => { dirty = true; });

  let before = null;
  function tick(now) {
    if (layout && session.mode === "saved" && playing) {
      if (before !== null) position = Math.min(position + ((now - before) / 1000) * layout.rate_hz * Number(element("speed").value), newest());
      if (position >= newest()) { playing = false; words(); }
      dirty = true;
    }
    before = now;
    // Thirty pictures a second are enough for an eye, and all that software rendering can do.
    if (layout && dirty && now - drawn >= 33) { dirty = false; drawn = now; draw(); }
    window.requestAnimationFrame(tick);
  }
  if (session.mode === "saved") {
    begin(session.layout, false);
    const bytes = Uint8Array.from(atob(session.rows), (letter) => letter.charCodeAt(0));
    store.push(session.first, session.count, new Float32Array(bytes.buffer));
    session.events.forEach(addEvent);
    following = false; position = store.first; state.oldest = store.first; ended = session.ended;
    words();
  } else connect();
  window.setInterval(() => { if (layout) words(); }, 1000);
  window.requestAnimationFrame(tick);
})();
