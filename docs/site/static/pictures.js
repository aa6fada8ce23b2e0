// Every picture of a page is a link to its file, which a browser shows in full size.
document.addEventListener("DOMContentLoaded", () => {
  for (const picture of document.querySelectorAll(".content img")) {
    if (picture.closest("a") || picture.src.startsWith("data:")) continue;
    const link = document.createElement("a");
    link.href = picture.src;
    link.className = "picture";
    link.title = "full size";
    picture.replaceWith(link);
    link.append(picture);
  }
});
