// Map of frames: a click shows the nearest dot's frame in the animation. The page calls this function,
// which sets no global variables, with the element of class map.
(element) => {
  const range = document.querySelector(".animation input[type=range]");
  const dots = [...element.querySelectorAll("circle")];
  const away = (dot, event) => {
    const { left, right, top, bottom } = dot.getBoundingClientRect();
    return Math.hypot((left + right) / 2 - event.clientX, (top + bottom) / 2 - event.clientY);
  };
  element.addEventListener("click", (event) => {
    const nearest = dots.reduce((a, b) => (away(b, event) < away(a, event) ? b : a));
    range.value = nearest.dataset.frame;
    range.dispatchEvent(new Event("input"));
  });
  let shown = null;
  const follow = () => {
    const dot = dots.findLast(({ dataset }) => Number(dataset.frame) <= Number(range.value));
    if (dot !== shown) {
      shown?.classList.remove("shown");
      dot.classList.add("shown");
      element.append(dot); // above the others
      shown = dot;
    }
    requestAnimationFrame(follow);
  };
  follow();
}
