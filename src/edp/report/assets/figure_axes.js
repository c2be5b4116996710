"use strict";
// Axes of a figure: values to pixels, limits, ticks, and texts of numbers. The forms are those that
// edp.report.common.interactive writes: plotly's words for figures, of which this page needs a few.
const FigureAxes = (function () {
  const NAMES = { "&amp;": "&", "&lt;": "<", "&gt;": ">", "&quot;": '"', "&#x27;": "'", "&#39;": "'" };

  // Texts come escaped, with <br> for a new line; they are shown as text, never as markup.
  function plain(text) {
    return String(text === undefined || text === null ? "" : text)
      .replace(/<br>/g, "\n").replace(/&(amp|lt|gt|quot|#x27|#39);/g, (name) => NAMES[name]);
  }

  // Arrays of numbers come as base64 of their bytes.
  function values(given) {
    if (!given || Array.isArray(given) || !given.bdata) return given || [];
    const bytes = Uint8Array.from(atob(given.bdata), (c) => c.charCodeAt(0)).buffer;
    const kind = {
      f8: Float64Array, f4: Float32Array, i4: Int32Array, u4: Uint32Array, i2: Int16Array, u2: Uint16Array,
      i1: Int8Array, u1: Uint8Array,
    }[given.dtype];
    const flat = Array.from(new kind(bytes));
    if (!given.shape) return flat;
    const width = Number(String(given.shape).split(",").pop());
    return Array.from({ length: flat.length / width }, (_, row) => flat.slice(row * width, (row + 1) * width));
  }

  function trimmed(text) {
    if (!text.includes(".")) return text;
    const [digits, power] = text.split("e");
    return digits.replace(/\.?0+$/, "") + (power === undefined ? "" : "e" + power);
  }

  function significant(value, digits) {
    if (value === 0) return "0";
    const power = Math.floor(Math.log10(Math.abs(value)));
    const text = power < -5 || power >= Math.max(digits, 6) ? value.toExponential(digits - 1) : value.toPrecision(digits);
    return trimmed(text.includes("e") && power >= -5 && power < 16 ? String(Number(text)) : text);
  }

  // A number by a format such as .4~g, +.2f or , (thousands).
  function number(value, form) {
    if (typeof value !== "number") return plain(value);
    const [, sign, comma, digits, kind] = /^([+]?)(,?)(?:\.(\d+))?~?([gf%d]?)$/.exec(form || "") || [];
    let text = kind === "f" ? value.toFixed(Number(digits)) : kind === "%" ? (100 * value).toFixed(Number(digits || 0)) + "%"
      : comma && digits === undefined ? String(Number(value.toPrecision(12))) : significant(value, Number(digits || 6));
    if (comma) text = text.replace(/^-?\d+/, (whole) => whole.replace(/\B(?=(\d{3})+$)/g, ","));
    return (sign && value > 0 ? "+" + text : text).replace("-", "\u2212");
  }

  function niceStep(span, most) {
    const rough = span / Math.max(most, 1);
    const power = Math.pow(10, Math.floor(Math.log10(rough)));
    return [1, 2, 5, 10].map((f) => f * power).find((step) => step >= rough * 0.999);
  }

  class Axis {
    constructor(name, options) {
      this.name = name;
      this.upright = name[0] === "y";
      this.options = options;
      this.log = options.type === "log";
      this.categories = options.type === "category" ? [] : null;
      this.low = Infinity;
      this.high = -Infinity;
      this.padded = false;
      this.barred = false;
    }

    // A value, or the place of a name, on a straight line; NaN where there is none.
    place(value) {
      if (value === null || value === undefined) return NaN;
      if (this.categories) {
        const at = this.categories.indexOf(value);
        return at >= 0 ? at : typeof value === "number" ? value : NaN;
      }
      return this.log ? Math.log10(value) : Number(value);
    }

    include(value) {
      if (this.categories) {
        if (value !== null && value !== undefined && !this.categories.includes(value)) this.categories.push(value);
        return;
      }
      const at = this.place(value);
      if (Number.isFinite(at)) {
        this.low = Math.min(this.low, at);
        this.high = Math.max(this.high, at);
      }
    }

    // Limits: the reader's zoom, the figure's own, or those of the data.
    settle(zoom) {
      const given = zoom || this.options.range;
      this.reversed = this.options.autorange === "reversed";
      if (given) {
        [this.low, this.high] = given;
        if (this.low > this.high) [this.low, this.high, this.reversed] = [this.high, this.low, true];
        return;
      }
      if (this.categories) {
        [this.low, this.high] = [-0.5, Math.max(this.categories.length, 1) - 0.5];
        return;
      }
      if (!(this.low <= this.high)) [this.low, this.high] = [0, 1];
      const zero = !this.log && (this.options.rangemode === "tozero" || this.barred);
      if (zero) [this.low, this.high] = [Math.min(this.low, 0), Math.max(this.high, 0)];
      const span = this.high - this.low || Math.abs(this.high) || 1;
      const pad = this.upright || this.padded ? 0.055 * span : 0;
      const flat = this.high === this.low ? 0.5 * span : 0;
      if (!(zero && this.low === 0)) this.low -= pad + flat;
      if (!(zero && this.high === 0)) this.high += pad + flat;
    }

    span(from, to) {
      [this.from, this.to] = this.reversed ? [to, from] : [from, to];
    }

    pixel(value) {
      return this.at(this.place(value));
    }

    at(place) {
      return this.from + ((place - this.low) / (this.high - this.low)) * (this.to - this.from);
    }

    back(pixel) {
      return this.low + ((pixel - this.from) / (this.to - this.from)) * (this.high - this.low);
    }

    // Place and text of each tick, for a length in pixels.
    ticks(length) {
      const inside = (row) => row[0] >= this.low - 1e-9 && row[0] <= this.high + 1e-9;
      const { tickvals, ticktext } = this.options;
      if (tickvals) return tickvals.map((value, i) => [this.place(value), plain(ticktext[i])]).filter(inside);
      if (this.categories) return this.categories.map((name, i) => [i, plain(name)]).filter(inside);
      if (this.log) return this.decades().filter(inside);
      const step = niceStep(this.high - this.low, Math.max(length / (this.upright ? 38 : 85), 3.5));
      const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
      const first = Math.ceil(this.low / step - 1e-9);
      const count = Math.floor(this.high / step + 1e-9) - first + 1;
      return Array.from({ length: Math.min(Math.max(count, 0), 60) }, (_, i) => {
        const value = (first + i) * step;
        const text = Math.abs(value) >= 1e6 || decimals > 5 ? significant(value, 4) : value.toFixed(decimals);
        return [value, text.replace(/^-(?=[0.]*$)/, "").replace("-", "\u2212")];
      });
    }

    decades() {
      const few = this.high - this.low < 1.6;
      const rows = [];
      for (let power = Math.floor(this.low); power <= Math.ceil(this.high); power += 1) {
        (few ? [1, 2, 5] : [1]).forEach((factor) => rows.push([power + Math.log10(factor), significant(factor * 10 ** power, 3)]));
      }
      const every = Math.ceil(rows.length / 12);
      return few ? rows : rows.filter((_, i) => i % every === 0);
    }
  }

  return { Axis, number, plain, values };
})();
