"use strict";
for (const slider of document.querySelectorAll(".slider")) {
  const input = slider.querySelector("input");
  const move = () => slider.style.setProperty("--at", input.value + "%");
  input.addEventListener("input", move);
  move();
}
for (const group of document.querySelectorAll("[data-choice]")) {
  const target = document.getElementById(group.dataset.choice);
  for (const button of group.querySelectorAll("button")) {
    button.addEventListener("click", () => {
      for (const other of group.querySelectorAll("button")) other.setAttribute("aria-pressed", other === button);
      for (const img of target.querySelectorAll("img[data-for]")) img.hidden = img.dataset.for !== button.value;
      const tag = target.querySelector(".tag[data-name]");
      if (tag) tag.textContent = button.textContent;
    });
  }
}
