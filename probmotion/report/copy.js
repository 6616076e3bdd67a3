// Copy the command, or select it if the browser does not allow copying.
(button) => {
  const command = button.previousElementSibling;
  const select = () => getSelection().selectAllChildren(command);
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(command.textContent);
      button.textContent = "copied";
    } catch {
      select();
    }
  });
}
