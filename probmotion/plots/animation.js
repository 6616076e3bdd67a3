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
  const colours = {};

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
      sds: data.sds.map((sd) => sd && new Int16Array(bytes(sd))),
    });

  const COLOURS = ["ink", "paper", "left", "right", "ghost", "ground", "shadow", "seen"];
  const readColours = () => {
    const style = getComputedStyle(element);
    for (const name of [...COLOURS, "certain", "between", "uncertain"]) {
      colours[name] = style.getPropertyValue(`--${name}`).trim();
    }
  };

  // Metres across and down from the centre, closeness and size, for an orthographic camera as in
  // Cameras.around or for the camera of the observations.
  const turned = () => {
    const [ca, sa] = [Math.cos(view.azimuth), Math.sin(view.azimuth)];
    const [ce, se] = [Math.cos(view.elevation), Math.sin(view.elevation)];
    return (x, y, z) => {
      const towards = sa * x + ca * z;
      return [ca * x - sa * z, se * towards - ce * (y - data.middle), ce * towards + se * y, 1];
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
        const size = perspective ? depth / far : 1;
        return [metres * (across - u), metres * (down - v), -far, size];
      },
      keypoint: (across, down) => [metres * (across - u), metres * (down - v)],
    };
  };

  const jointsOf = ({ unit, numbers }, frame, see) => {
    const joints = [];
    for (let at = 3 * data.joints * frame; joints.length < data.joints; at += 3) {
      joints.push(see(unit * numbers[at], unit * numbers[at + 1], unit * numbers[at + 2]));
    }
    return joints;
  };
  const headOf = (joints) => {
    const mean = (axis) =>
      data.head.reduce((sum, joint) => sum + joints[joint][axis], 0) / data.head.length;
    return [0, 1, 2, 3].map(mean);
  };
  const circle = (pen, [x, y], radius) => {
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
  };
  // A body in a single colour: the truth, other draws and shadows.
  const silhouette = (pen, joints, colour, opacity, thickness) => {
    pen.globalAlpha = opacity;
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = thickness * data.thickness * joints[0][3];
    // A single path, because overlapping translucent strokes would be darker.
    pen.beginPath();
    data.bones.forEach(([a, b]) => {
      pen.moveTo(joints[a][0], joints[a][1]);
      pen.lineTo(joints[b][0], joints[b][1]);
    });
    pen.stroke();
    if (data.head.length) {
      const head = headOf(joints);
      circle(pen, head, thickness * data.headRadius * head[3]);
      pen.fill();
    }
    pen.globalAlpha = 1;
  };
  // A body of capsules, near ones in front of far ones.
  const body = (pen, joints, colourOf) => {
    const inHead = (joint) => data.head.includes(joint);
    const parts = data.bones
      .filter(([a, b]) => !(inHead(a) && inHead(b)))
      .map((bone) => [joints[bone[0]][2] + joints[bone[1]][2], bone]);
    const head = data.head.length ? headOf(joints) : null;
    if (head) parts.push([2 * head[2] + data.headRadius, null]);
    parts.sort(([one], [other]) => one - other);
    parts.forEach(([, bone]) => {
      if (bone) {
        const [a, b] = [joints[bone[0]], joints[bone[1]]];
        const width = 0.5 * data.thickness * (a[3] + b[3]);
        for (const [colour, wide] of [[colours.paper, width + 1.6], [colourOf(bone), width]]) {
          pen.beginPath();
          pen.moveTo(a[0], a[1]);
          pen.lineTo(b[0], b[1]);
          pen.strokeStyle = colour;
          pen.lineWidth = wide;
          pen.stroke();
        }
        return;
      }
      const radius = data.headRadius * head[3];
      for (const [colour, size] of [[colours.paper, radius + 0.8], [colourOf(null), radius]]) {
        circle(pen, head, size);
        pen.fillStyle = colour;
        pen.fill();
      }
    });
  };
  const ring = (pen, place, size) => {
    circle(pen, place, size);
    pen.lineWidth = 1.5;
    pen.strokeStyle = colours.seen;
    pen.stroke();
  };
  // Colour of a standard deviation, millimetres.
  const shade = (sd) => {
    const at = 2 * Math.min(1, sd / data.largestSd);
    const [from, to] = at < 1 ? ["certain", "between"] : ["between", "uncertain"];
    const channel = (name, place) => parseInt(colours[name].slice(1 + 2 * place, 3 + 2 * place), 16);
    const mixed = [0, 1, 2].map(
      (place) => channel(from, place) + (at - Math.floor(Math.min(at, 1))) *
        (channel(to, place) - channel(from, place)),
    );
    return `rgb(${mixed.map(Math.round)})`;
  };
  // Colours of bones: by their side, or by the standard deviations of their joints.
  const colouring = (pen, joints, sd, frame) => {
    if (!sd) return (bone) => colours[data.overlaid ? "ink" : (bone?.[2] ?? "ink")];
    const of = (joint) => shade(sd[data.joints * frame + joint]);
    return (bone) => {
      if (!bone) return of(data.head[0]);
      const [a, b] = [joints[bone[0]], joints[bone[1]]];
      const gradient = pen.createLinearGradient(a[0], a[1], b[0], b[1]);
      gradient.addColorStop(0, of(bone[0]));
      gradient.addColorStop(1, of(bone[1]));
      return gradient;
    };
  };

  const drawPlace = (pen, motions, sd, frame, scale) => {
    const film = throughCamera ? filmed(frame) : null;
    const see = film ? film.body : turned();
    const pixels = (...where) => {
      const [x, y, near, size] = see(...where);
      return [scale * x, scale * y, near, scale * size];
    };
    const [low, r] = [data.low, data.reach / Math.SQRT2];
    pen.beginPath();
    for (const [x, z] of [[-r, -r], [r, -r], [r, r], [-r, r]]) {
      pen.lineTo(...pixels(x, low, z).slice(0, 2));
    }
    pen.closePath();
    pen.fillStyle = colours.ground;
    pen.fill();
    const flat = (x, _, z) => pixels(x, low, z);
    silhouette(pen, jointsOf(motions[0], frame, flat), colours.shadow, 1, 0.8);
    const isTruth = data.overlaid && motions.length === 1;
    if (decoded.truth && truthBox.checked && !isTruth) {
      silhouette(pen, jointsOf(decoded.truth, frame, pixels), colours.ghost, 1, 1.25);
    }
    motions.slice(1).forEach((other) => {
      silhouette(pen, jointsOf(other, frame, pixels), colours.ink, 0.12, 0.7);
    });
    const joints = jointsOf(motions[0], frame, pixels);
    body(pen, joints, colouring(pen, joints, sd, frame));
    const size = Math.max(2, 0.7 * data.thickness * scale);
    for (let joint = 0; joint < data.joints; joint++) {
      const at = frame * data.joints + joint;
      if (decoded.dots && !isNaN(decoded.dots[3 * at])) {
        ring(pen, pixels(...decoded.dots.subarray(3 * at, 3 * at + 3)), size);
      }
      if (film && decoded.keypoints && !isNaN(decoded.keypoints[2 * at])) {
        const [x, y] = film.keypoint(...decoded.keypoints.subarray(2 * at, 2 * at + 2));
        ring(pen, [scale * x, scale * y], size);
      }
    }
  };

  const canvases = [...element.querySelectorAll("canvas")];
  const drawCanvas = (canvas, row, frame) => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    const sharp = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [Math.round(sharp * width), Math.round(sharp * height)];
    const pen = canvas.getContext("2d");
    pen.lineCap = pen.lineJoin = "round";
    const place = width / data.columns;
    const scale = Math.min(place / data.across, height / data.up);
    const motions = decoded.rows[row];
    const places = data.overlaid ? [motions] : motions.map((each) => [each]);
    places.forEach((shown, column) => {
      pen.setTransform(sharp, 0, 0, sharp, sharp * column * place, 0);
      pen.save();
      pen.beginPath();
      pen.rect(0, 0, place, height);
      pen.clip();
      pen.translate(place / 2, height / 2);
      drawPlace(pen, shown, decoded.sds[row], frame, scale);
      pen.restore();
    });
  };
  const draw = () => {
    const frame = Math.floor(moment);
    decode();
    canvases.forEach((canvas, row) => drawCanvas(canvas, row, frame));
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
  window.addEventListener("resize", repaint);
  // Print also animations that were never on the screen, on white paper.
  const print = (printing) => {
    document.documentElement.classList.toggle("printing", printing);
    readColours();
    if (printing || decoded) draw();
  };
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));
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
