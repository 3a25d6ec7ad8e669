"use strict";
// Values under the pointer, or under the arrow keys; and a button that copies a command.

const format = (value, share) =>
  share ? `${Number((100 * value).toPrecision(3))} %` : value.toLocaleString("en", { maximumSignificantDigits: 4 });

function nearest(xs, x) {
  let best = 0;
  for (let i = 1; i < xs.length; i++) if (Math.abs(xs[i] - x) < Math.abs(xs[best] - x)) best = i;
  return best;
}

function follow(plot) {
  const data = JSON.parse(plot.querySelector("script").textContent);
  const [cross, tip] = [plot.querySelector(".cross"), plot.querySelector(".tip")];
  const [x0, x1] = data.x;
  const every = [...new Set(data.series.flatMap((s) => s.x))].sort((a, b) => a - b);
  let at = null;

  function hide() { cross.hidden = tip.hidden = true; at = null; }

  function show(x) {
    at = every[nearest(every, x)];
    const share = (at - x0) / (x1 - x0);
    const rows = [];
    for (const s of data.series) {
      if (!s.x.length) continue;
      const i = nearest(s.x, at);
      // A line that has ended, or has no point near, says nothing here.
      if (Math.abs(s.x[i] - at) > (x1 - x0) * 0.02) continue;
      const range = s.low ? ` (${format(s.low[i], data.share)} to ${format(s.high[i], data.share)})` : "";
      rows.push([s, s.y[i], `${format(s.y[i], data.share)}${range}`]);
    }
    if (rows.length > 10) rows.sort((a, b) => b[1] - a[1]);
    tip.replaceChildren(line("", `${format(at, false)} ${data.label}`, "tip-x"));
    for (const [s, , text] of rows) tip.append(line(s.style, `${s.name}: ${text}`, "tip-row"));
    cross.hidden = tip.hidden = false;
    cross.style.left = `${100 * share}%`;
    const room = plot.clientWidth - tip.offsetWidth;
    const wished = share * plot.clientWidth + (share < 0.5 ? 12 : -12 - tip.offsetWidth);
    tip.style.left = `${Math.max(Math.min(0, room), Math.min(wished, Math.max(0, room)))}px`;
  }

  function line(style, text, name) {
    const row = document.createElement("div");
    row.className = name;
    if (style) {
      const key = document.createElement("span");
      key.className = `swatch ${style}`;
      row.append(key);
    }
    row.append(text);  // as text, never as HTML
    return row;
  }

  plot.addEventListener("pointermove", (event) => {
    const box = plot.getBoundingClientRect();
    show(x0 + ((event.clientX - box.left) / box.width) * (x1 - x0));
  });
  plot.addEventListener("pointerleave", hide);
  plot.addEventListener("blur", hide);
  plot.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === "Escape") hide();
    if (!step || !every.length) return;
    event.preventDefault();
    const i = at === null ? 0 : nearest(every, at) + step;
    show(every[Math.max(0, Math.min(every.length - 1, i))]);
  });
}

document.querySelectorAll(".plot").forEach(follow);

for (const block of document.querySelectorAll(".commands dd")) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "copy";
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(block.querySelector("code").textContent);
      button.textContent = "copied";
    } catch {
      getSelection().selectAllChildren(block.querySelector("code"));
      button.textContent = "selected";
    }
  });
  block.append(button);
}

if (matchMedia("(prefers-reduced-motion: reduce)").matches)
  for (const video of document.querySelectorAll("video")) { video.autoplay = false; video.pause(); }
