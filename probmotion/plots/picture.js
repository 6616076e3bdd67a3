// Keypoints of the frame that an animation shows, and the command that starts from this frame. The
// page calls this function, which sets no global variables, with the element of class picture.
(element) => {
  const { step, commands, seeds } = JSON.parse(element.querySelector("script").textContent);
  const animation = document.querySelector(".animation");
  const data = JSON.parse(animation.querySelector("script").textContent);
  const range = animation.querySelector("input[type=range]");
  const [canvas, code] = [element.querySelector("canvas"), element.querySelector("code")];
  const letters = Uint8Array.from(atob(data.keypoints), (letter) => letter.charCodeAt(0));
  const points = new Float32Array(letters.buffer);
  const ends = [0, 1].map((axis) => {
    const values = points.filter((value, at) => at % 2 === axis && !isNaN(value));
    return [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  });

  const draw = (frame) => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const sharp = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [Math.round(sharp * width), Math.round(sharp * height)];
    const pen = canvas.getContext("2d");
    const spans = ends.map(([low, high]) => 1.05 * (high - low) + 0.01);
    const scale = Math.min(width / spans[0], height / spans[1]);
    const place = (joint) =>
      [0, 1].map(
        (axis) =>
          scale * (points[2 * (data.joints * frame + joint) + axis] - (ends[axis][0] + ends[axis][1]) / 2),
      );
    const style = getComputedStyle(animation);
    pen.setTransform(sharp, 0, 0, sharp, (sharp * width) / 2, (sharp * height) / 2);
    pen.lineCap = "round";
    pen.lineWidth = 3;
    for (const [joint, parent, side] of data.bones) {
      const [from, to] = [place(parent), place(joint)];
      if (isNaN(from[0] + to[0])) continue;
      pen.strokeStyle = style.getPropertyValue(`--${side}`).trim();
      pen.beginPath();
      pen.moveTo(...from);
      pen.lineTo(...to);
      pen.stroke();
    }
  };
  let shown = -1;
  const follow = () => {
    const frame = Number(range.value);
    if (frame !== shown || canvas.width === 0) {
      shown = frame;
      draw(frame);
      const number = step * frame;
      code.textContent = (seeds[number] ? commands.start : commands.refused).join(number);
    }
    requestAnimationFrame(follow);
  };
  window.addEventListener("resize", () => (shown = -1));
  follow();
}
