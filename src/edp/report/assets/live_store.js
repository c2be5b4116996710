"use strict";
/* Rows of a session as the page keeps them: a ring of the newest ticks, and one stretch from further back. */
function edpStore(width, most) {
  const capacity = Math.max(1000, Math.floor(most / (4 * width)));
  const ring = new Float32Array(capacity * width).fill(NaN);
  let begin = null, end = 0, past = { first: 0, count: 0, rows: new Float32Array(0) };

  const put = (first, count, rows, from) => {
    for (let k = from; k < count; k++) {
      ring.set(rows.subarray(k * width, (k + 1) * width), ((first + k) % capacity) * width);
    }
  };
  return {
    get first() { return begin === null ? 0 : Math.max(begin, end - capacity); },
    get end() { return end; },
    /* New rows; ticks that were dropped on the way are gaps. */
    push(first, count, rows) {
      if (begin === null) { begin = first; end = first; }
      for (let tick = Math.max(end, first - capacity); tick < first; tick++) ring.fill(NaN, (tick % capacity) * width, (tick % capacity + 1) * width);
      put(first, count, rows, Math.max(0, count - capacity));
      end = Math.max(end, first + count);
    },
    /* Rows from further back. */
    look(first, count, rows) {
      if (begin === null || (first <= this.first && first + count >= this.first && first + count > end - capacity)) {
        if (begin === null) end = first + count;
        put(first, count, rows, Math.max(0, end - capacity - first));
        begin = Math.max(first, end - capacity);
      } else if (first >= this.first) put(first, count, rows, 0);
      else past = { first, count, rows };
    },
    has(first, stop) {
      return (first >= this.first && begin !== null) || (first >= past.first && Math.min(stop, this.first) <= past.first + past.count);
    },
    at(tick, column) {
      if (tick < 0 || tick >= end) return NaN;
      if (begin !== null && tick >= this.first) return ring[(tick % capacity) * width + column];
      const row = tick - past.first;
      return row >= 0 && row < past.count ? past.rows[row * width + column] : NaN;
    },
  };
}

/* A message of rows: kind (1 new, 2 from further back), first tick, rows, time of the newest. */
function edpRows(buffer) {
  const head = new DataView(buffer, 0, 24), [kind, first, count, width] = [0, 4, 8, 12].map((k) => head.getUint32(k, true));
  return { kind, first, count, stamp: head.getFloat64(16, true), rows: new Float32Array(buffer, 24, count * width) };
}
