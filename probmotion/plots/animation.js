// Stick figures that play. Nothing is global: all lives in this function, which playing.py calls
// with the element of one figure and what is to be drawn in it.
(figure, data) => {
  const [canvas, button, range] = ["canvas", "button", "input"].map((x) => figure.querySelector(x));
  const pen = canvas.getContext("2d");
  const view = { azimuth: 0.6, elevation: 0.2 };
  let playing = false;
  let moment = 0; // frames since the first, with a fraction
  let drawn = 0; // when the last picture was drawn, milliseconds
  let held = null; // where the pointer that turns was last

  // The axes of Cameras.around, orthographic; x and y in pixels from the middle of a place.
  const camera = () => {
    const [ca, sa] = [Math.cos(view.azimuth), Math.sin(view.azimuth)];
    const [ce, se] = [Math.cos(view.elevation), Math.sin(view.elevation)];
    return (x, y, z) => {
      const towards = sa * x + ca * z;
      return {
        x: data.scale * (ca * x - sa * z),
        y: data.scale * (se * towards - ce * (y - data.middle)),
        near: ce * towards + se * y,
      };
    };
  };

  const path = (points, colour, width) => {
    pen.beginPath();
    points.forEach((point) => pen.lineTo(point.x, point.y));
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke();
  };

  const drawBody = (numbers, frame, see) => {
    const [low, r] = [data.low, data.reach / Math.SQRT2];
    const corners = [[-r, -r], [r, -r], [r, r], [-r, r], [-r, -r]];
    path(corners.map(([x, z]) => see(x, low, z)), data.floor, 1);
    const joints = [];
    for (let at = 3 * data.joints * frame; joints.length < data.joints; at += 3) {
      joints.push(see(...numbers.slice(at, at + 3).map((millimetres) => millimetres / 1000)));
    }
    const near = ([a, b]) => joints[a].near + joints[b].near;
    const bones = [...data.bones].sort((one, other) => near(one) - near(other));
    bones.forEach(([a, b, side]) => path([joints[a], joints[b]], data.colours[side], 2.5));
  };

  const draw = () => {
    const sharp = window.devicePixelRatio || 1;
    canvas.width = sharp * data.width;
    canvas.height = sharp * data.height;
    pen.lineCap = pen.lineJoin = "round";
    pen.font = "14px sans-serif";
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const frame = Math.floor(moment);
    const see = camera();
    data.rows.forEach((row, r) => {
      pen.setTransform(sharp, 0, 0, sharp, 0, sharp * r * data.place.height);
      pen.fillStyle = data.ink;
      row.label.forEach((line, n) => {
        const y = data.place.height / 2 + 18 * (n - (row.label.length - 1) / 2);
        pen.fillText(line, data.margin - 10, y, data.margin - 10);
      });
      row.motions.forEach((numbers, column) => {
        pen.save();
        pen.translate(data.margin + column * data.place.width, 0);
        pen.beginPath();
        pen.rect(0, 0, data.place.width, data.place.height);
        pen.clip();
        pen.translate(data.place.width / 2, data.place.height / 2);
        drawBody(numbers, frame, see);
        pen.restore();
      });
    });
    range.value = frame;
    range.setAttribute("aria-valuetext", `frame ${frame + 1} of ${data.frames}`);
    button.textContent = playing ? "Pause" : "Play";
  };

  const tick = (now) => {
    if (!playing) return;
    // The first picture may be due before play was pressed; a page that was hidden goes on where
    // it was.
    const passed = Math.max(0, Math.min(now - drawn, 250)) / 1000;
    moment = (moment + passed * data.fps) % data.frames;
    drawn = Math.max(now, drawn);
    draw();
    requestAnimationFrame(tick);
  };

  const toggle = () => {
    playing = !playing;
    drawn = performance.now();
    if (playing) requestAnimationFrame(tick);
    draw();
  };

  const turn = (azimuth, elevation) => {
    view.azimuth += azimuth;
    view.elevation = Math.max(-1.5, Math.min(1.5, view.elevation + elevation));
    draw();
  };

  const turns = {
    ArrowLeft: [0.1, 0],
    ArrowRight: [-0.1, 0],
    ArrowUp: [0, -0.1],
    ArrowDown: [0, 0.1],
  };
  figure.addEventListener("keydown", (event) => {
    // A button presses itself, and a slider moves itself.
    if (event.key === " " && event.target !== button) toggle();
    else if (event.key in turns && event.target === canvas) turn(...turns[event.key]);
    else return;
    event.preventDefault();
  });
  button.addEventListener("click", toggle);
  range.addEventListener("input", () => {
    moment = Number(range.value);
    draw();
  });
  canvas.addEventListener("pointerdown", (event) => {
    held = { x: event.clientX, y: event.clientY };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    turn(0.01 * (held.x - event.clientX), 0.01 * (event.clientY - held.y));
    held = { x: event.clientX, y: event.clientY };
  });
  ["pointerup", "pointercancel"].forEach((end) =>
    canvas.addEventListener(end, () => {
      held = null;
    }),
  );

  if (window.matchMedia("(prefers-reduced-motion: reduce)").matches) draw();
  else toggle();
}
