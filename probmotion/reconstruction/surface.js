// Surfaces of posterior draws in motion, one at a time. The page calls this function, which sets no
// global variables, with each element of class surface.
(element) => {
  const data = JSON.parse(element.querySelector("script").textContent);
  const canvas = element.querySelector("canvas");
  const [playButton, output] = ["[data-does=play]", "output"].map((each) => element.querySelector(each));
  const buttons = [...element.querySelectorAll("[data-draw]")];
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)");
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const triangles = new Uint16Array(bytes(data.triangles).buffer);
  const draws = data.vertices.map((text, at) => ({
    numbers: new Int16Array(bytes(text).buffer),
    colours: bytes(data.colours[at]),
  }));
  const count = draws[0].colours.length; // of coordinates in a frame
  const light = [-0.4, 0.7, 0.6]; // from the upper left, in the axes of the view
  const view = { azimuth: 0, elevation: 0 };
  let shown = 0;
  let playing = false;
  let visible = false;
  let moment = 0; // current frame, with a fraction
  let drawn = 0; // time of the last drawn frame, milliseconds
  let waiting = 0; // id of the requested animation frame
  let pointer = null; // last position of the dragging pointer

  // Coordinates of all vertices at the moment: right, up and towards the viewer, metres.
  const seen = new Float32Array(count);
  const turn = () => {
    const { numbers } = draws[shown];
    const frame = Math.min(Math.floor(moment), data.frames - 1);
    const rest = moment - frame;
    const [one, other] = [frame * count, Math.min(frame + 1, data.frames - 1) * count];
    const [ca, sa] = [Math.cos(view.azimuth), Math.sin(view.azimuth)];
    const [ce, se] = [Math.cos(view.elevation), Math.sin(view.elevation)];
    for (let at = 0; at < count; at += 3) {
      const [x, y, z] = [0, 1, 2].map(
        (axis) => data.unit * ((1 - rest) * numbers[one + at + axis] + rest * numbers[other + at + axis]),
      );
      const near = sa * x + ca * z;
      seen[at] = ca * x - sa * z;
      seen[at + 1] = ce * y - se * near;
      seen[at + 2] = se * y + ce * near;
    }
  };
  const draw = () => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    const sharp = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [Math.round(sharp * width), Math.round(sharp * height)];
    const pen = canvas.getContext("2d");
    const scale = (0.48 * sharp * Math.min(width, height)) / data.reach;
    pen.setTransform(scale, 0, 0, -scale, canvas.width / 2, canvas.height / 2);
    pen.lineWidth = 0.7 / scale; // strokes hide the gaps between triangles
    pen.lineJoin = "round";
    turn();
    const { colours } = draws[shown];
    const faces = [];
    for (let at = 0; at < triangles.length; at += 3) {
      const [a, b, c] = [3 * triangles[at], 3 * triangles[at + 1], 3 * triangles[at + 2]];
      const u = [0, 1, 2].map((axis) => seen[b + axis] - seen[a + axis]);
      const v = [0, 1, 2].map((axis) => seen[c + axis] - seen[a + axis]);
      const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      if (normal[2] <= 0) continue; // seen from inside
      const lit = normal.reduce((sum, value, axis) => sum + value * light[axis], 0) / Math.hypot(...normal);
      faces.push([seen[a + 2] + seen[b + 2] + seen[c + 2], a, b, c, 0.5 + 0.6 * Math.max(0, lit)]);
    }
    faces.sort(([one], [other]) => one - other);
    for (const [, a, b, c, lit] of faces) {
      const colour = [0, 1, 2].map((axis) =>
        Math.round((lit * (colours[a + axis] + colours[b + axis] + colours[c + axis])) / 3),
      );
      pen.fillStyle = pen.strokeStyle = `rgb(${colour})`;
      pen.beginPath();
      for (const corner of [a, b, c]) pen.lineTo(seen[corner], seen[corner + 1]);
      pen.closePath();
      pen.fill();
      pen.stroke();
    }
    playButton.textContent = playing ? "Stop" : "Play";
    output.textContent = buttons[shown].dataset.caption;
    buttons.forEach((button, at) => button.setAttribute("aria-pressed", String(at === shown)));
  };

  const next = () => {
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(tick);
  };
  const tick = (now) => {
    if (!playing || !visible) return;
    // A page that was hidden continues where it stopped.
    moment += (Math.max(0, Math.min(now - drawn, 250)) / 1000) * data.fps;
    drawn = Math.max(now, drawn);
    // The last frame stays as long as the others before the motion starts again.
    if (moment >= data.frames) moment = 0;
    draw();
    next();
  };
  let begun = false; // automatically or by the user
  const go = (on) => {
    begun = true;
    playing = on;
    drawn = performance.now();
    if (playing) next();
    draw();
  };
  const rotate = (azimuth, elevation) => {
    view.azimuth += azimuth;
    view.elevation = Math.max(-1.5, Math.min(1.5, view.elevation + elevation));
    draw();
  };
  const keys = {
    " ": () => go(!playing),
    ArrowLeft: () => rotate(0.1, 0),
    ArrowRight: () => rotate(-0.1, 0),
    ArrowUp: () => rotate(0, -0.1),
    ArrowDown: () => rotate(0, 0.1),
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
  playButton.addEventListener("click", keys[" "]);
  buttons.forEach((button, at) =>
    button.addEventListener("click", () => {
      shown = at;
      draw();
    }),
  );
  canvas.addEventListener("pointerdown", (event) => {
    pointer = { x: event.clientX, y: event.clientY };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointer) return;
    rotate(0.01 * (pointer.x - event.clientX), 0.01 * (event.clientY - pointer.y));
    pointer = { x: event.clientX, y: event.clientY };
  });
  ["pointerup", "pointercancel"].forEach((end) => canvas.addEventListener(end, () => (pointer = null)));
  window.addEventListener("resize", draw);
  window.addEventListener("beforeprint", draw);
  new IntersectionObserver((entries) => {
    const before = visible;
    visible = entries.at(-1).isIntersecting;
    // A surface that the user has not stopped continues when it becomes visible again.
    if (visible && !before) go(begun ? playing : data.frames > 1 && !calm.matches);
  }).observe(element);
}
