"use strict";
// by name: the buttons that come by default offer to upload a chart
const buttons = [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
const config = { responsive: true, displaylogo: false, modeBarButtons: buttons };
const figures = JSON.parse(document.getElementById("figures").textContent);
for (const figure of figures) {
  const place = document.getElementById(figure.id);
  if (figure.aspect) {  // of a map: on a phone it is less high
    const height = Math.max(320, place.clientWidth * figure.aspect + figure.frame);
    figure.layout.height = Math.min(figure.layout.height, height);
    place.style.height = `${figure.layout.height}px`;
  }
  if (place.clientWidth < 600 && figure.data.length > 4) {  // the legend has a row each
    figure.layout.height += 12 * figure.data.length;
    place.style.height = `${figure.layout.height}px`;
  }
  Plotly.newPlot(place, figure.data, figure.layout, config);
}
// paper has another width than the screen, and nothing else tells the charts
const fit = () => figures.forEach((figure) => Plotly.Plots.resize(figure.id));
addEventListener("beforeprint", fit);
addEventListener("afterprint", fit);
