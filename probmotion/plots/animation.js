// Animated skeletons of one problem: a canvas per sampler, with a common clock and view. The page
// calls this function, which sets no global variables, with each element of class animation.
(element) => {
  const find = (selector) => element.querySelector(selector);
  const data = JSON.parse(find("script").textContent);
  const [playButton, cameraButton] = [find("[data-does=play]"), find("[data-does=camera]")];
  const [range, truthBox, output] = [find("input[type=range]"), find("[data-does=truth]"), find("output")];
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)");
  const view = { azimuth: data.azimuth, elevation: 0.2 };
  let throughCamera = false;
  let playing = false;
  let visible = false;
  let moment = 0; // current frame, with a fraction
  let drawn = 0; // time of the last drawn frame, milliseconds
  let waiting = 0; // id of the requested animation frame
  let pointer = null; // last position of the dragging pointer
  let colours = {};

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const motion = ({ unit, numbers }) => ({ unit: unit / 1000, numbers: new Int16Array(bytes(numbers)) });
  const floats = (text) => (text ? new Float32Array(bytes(text)) : null);
  let decoded = null; // decoded when first drawn
  const decode = () =>
    (decoded ??= {
      rows: data.rows.map((motions) => motions.map(motion)),
      truth: data.truth && motion(data.truth),
      keypoints: floats(data.keypoints),
      dots: floats(data.dots),
    });

  const readColours = () => {
    const style = getComputedStyle(element);
    for (const name of ["ink", "left", "right", "ghost", "rule", "seen", "paper"]) {
      colours[name] = style.getPropertyValue(`--${name}`).trim();
    }
  };

  // Metres across and down from the centre, and nearness, for an orthographic camera as in
  // Cameras.around or for the camera of the observations.
  const turned = () => {
    const [ca, sa] = [Math.cos(view.azimuth), Math.sin(view.azimuth)];
    const [ce, se] = [Math.cos(view.elevation), Math.sin(view.elevation)];
    return (x, y, z) => {
      const towards = sa * x + ca * z;
      return [ca * x - sa * z, se * towards - ce * (y - data.middle), ce * towards + se * y];
    };
  };
  const filmed = (frame) => {
    const { rotation: r, translation: t, focal, centre, perspective } = data.camera;
    const [ax, az] = data.anchor[frame];
    const shown = (x, y, z) => {
      const [right, down, depth] = [0, 1, 2].map(
        (row) => r[row][0] * x + r[row][1] * y + r[row][2] * z + t[row],
      );
      const size = perspective ? focal / depth : focal;
      return [size * right + centre[0], size * down + centre[1], depth];
    };
    const [u, v, depth] = shown(ax, data.middle, az);
    const metres = (perspective ? depth : 1) / focal;
    return {
      body: (x, y, z) => {
        const [across, down, far] = shown(x + ax, y, z + az);
        return [metres * (across - u), metres * (down - v), -far];
      },
      keypoint: (across, down) => [metres * (across - u), metres * (down - v)],
    };
  };

  const path = (pen, points, colour, width) => {
    pen.beginPath();
    points.forEach(([x, y]) => pen.lineTo(x, y));
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke();
  };
  const jointsOf = ({ unit, numbers }, frame, see) => {
    const joints = [];
    for (let at = 3 * data.joints * frame; joints.length < data.joints; at += 3) {
      joints.push(see(unit * numbers[at], unit * numbers[at + 1], unit * numbers[at + 2]));
    }
    return joints;
  };
  const dot = (pen, [x, y], size) => {
    pen.beginPath();
    pen.arc(x, y, size, 0, 2 * Math.PI);
    pen.lineWidth = 1.5;
    pen.strokeStyle = colours.seen;
    pen.stroke();
  };

  const drawPlace = (pen, numbers, frame, scale, thin) => {
    const film = throughCamera ? filmed(frame) : null;
    const see = film ? film.body : turned();
    const pixels = (...where) => {
      const [x, y, near] = see(...where);
      return [scale * x, scale * y, near];
    };
    const [low, r] = [data.low, data.reach / Math.SQRT2];
    const corners = [[-r, -r], [r, -r], [r, r], [-r, r], [-r, -r]];
    path(pen, corners.map(([x, z]) => pixels(x, low, z)), colours.rule, 1);
    if (decoded.truth && truthBox.checked) {
      const joints = jointsOf(decoded.truth, frame, pixels);
      data.bones.forEach(([a, b]) => path(pen, [joints[a], joints[b]], colours.ghost, 2.4 * thin));
    }
    const joints = jointsOf(numbers, frame, pixels);
    const near = ([a, b]) => joints[a][2] + joints[b][2];
    const bones = [...data.bones].sort((one, other) => near(one) - near(other));
    bones.forEach(([a, b, side]) => path(pen, [joints[a], joints[b]], colours[side], 1.2 * thin));
    for (let joint = 0; joint < data.joints; joint++) {
      const at = frame * data.joints + joint;
      if (decoded.dots && !isNaN(decoded.dots[3 * at])) {
        dot(pen, pixels(...decoded.dots.subarray(3 * at, 3 * at + 3)), 1.3 * thin);
      }
      if (film && decoded.keypoints && !isNaN(decoded.keypoints[2 * at])) {
        const [x, y] = film.keypoint(...decoded.keypoints.subarray(2 * at, 2 * at + 2));
        dot(pen, [scale * x, scale * y], 1.3 * thin);
      }
    }
  };

  const canvases = [...element.querySelectorAll("canvas")];
  const drawCanvas = (canvas, motions, frame) => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    const sharp = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [Math.round(sharp * width), Math.round(sharp * height)];
    const pen = canvas.getContext("2d");
    pen.lineCap = pen.lineJoin = "round";
    const place = width / data.columns;
    const scale = Math.min(place / data.across, height / data.up);
    const thin = Math.max(1, Math.min(1.8, height / 130));
    motions.forEach((numbers, column) => {
      pen.setTransform(sharp, 0, 0, sharp, sharp * column * place, 0);
      pen.save();
      pen.beginPath();
      pen.rect(0, 0, place, height);
      pen.clip();
      pen.translate(place / 2, height / 2);
      drawPlace(pen, numbers, frame, scale, thin);
      pen.restore();
    });
  };
  const draw = () => {
    const frame = Math.floor(moment);
    decode();
    canvases.forEach((canvas, row) => drawCanvas(canvas, decoded.rows[row], frame));
    range.value = frame;
    const words = `frame ${frame + 1} of ${data.frames}`;
    range.setAttribute("aria-valuetext", words);
    output.textContent = data.frames > 1 ? words : "";
    playButton.textContent = playing ? "Stop" : "Play";
    cameraButton.setAttribute("aria-pressed", String(throughCamera));
  };

  const next = () => {
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(tick);
  };
  const tick = (now) => {
    if (!playing || !visible) return;
    // A page that was hidden continues where it stopped.
    const passed = Math.max(0, Math.min(now - drawn, 250)) / 1000;
    const before = Math.floor(moment);
    moment = (moment + passed * data.fps) % data.frames;
    drawn = Math.max(now, drawn);
    if (Math.floor(moment) !== before) draw();
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
  const scrub = (frame) => {
    moment = Math.max(0, Math.min(data.frames - 1, frame));
    go(false);
  };
  const turn = (azimuth, elevation) => {
    if (throughCamera) Object.assign(view, { azimuth: data.camera.azimuth, elevation: data.camera.elevation });
    throughCamera = false;
    view.azimuth += azimuth;
    view.elevation = Math.max(-1.5, Math.min(1.5, view.elevation + elevation));
    draw();
  };
  const useCamera = () => {
    throughCamera = Boolean(data.camera) && !throughCamera;
    draw();
  };

  const keys = {
    " ": () => go(data.frames > 1 && !playing),
    Home: () => scrub(0),
    End: () => scrub(data.frames - 1),
    ",": () => scrub(Math.floor(moment) - 1),
    ".": () => scrub(Math.floor(moment) + 1),
    ArrowLeft: () => turn(0.1, 0),
    ArrowRight: () => turn(-0.1, 0),
    ArrowUp: () => turn(0, -0.1),
    ArrowDown: () => turn(0, 0.1),
    c: useCamera,
  };
  element.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
    // The browser handles keys of buttons, boxes and sliders.
    const moves = event.key.startsWith("Arrow") || event.key === "Home" || event.key === "End";
    if (event.target === range ? moves : event.key === " " && event.target.closest("button, input"))
      return;
    event.preventDefault();
    keys[event.key]();
  });
  playButton.addEventListener("click", keys[" "]);
  cameraButton.addEventListener("click", useCamera);
  truthBox.addEventListener("change", draw);
  range.addEventListener("input", () => scrub(Number(range.value)));
  canvases.forEach((canvas) => {
    canvas.addEventListener("pointerdown", (event) => {
      pointer = { x: event.clientX, y: event.clientY };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!pointer) return;
      turn(0.01 * (pointer.x - event.clientX), 0.01 * (event.clientY - pointer.y));
      pointer = { x: event.clientX, y: event.clientY };
    });
    ["pointerup", "pointercancel"].forEach((end) =>
      canvas.addEventListener(end, () => (pointer = null)),
    );
  });

  const repaint = () => {
    readColours();
    if (decoded) draw();
  };
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  ["beforeprint", "afterprint", "resize"].forEach((when) => window.addEventListener(when, repaint));
  readColours();
  const appear = () => {
    visible = true;
    // Animations that the user has not stopped continue when they become visible again.
    go(begun ? playing : data.frames > 1 && !calm.matches);
  };
  new IntersectionObserver((entries) => {
    if (!entries.at(-1).isIntersecting) visible = false;
    else if (!visible) appear();
  }).observe(element);
}
