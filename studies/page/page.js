"use strict";
// by name: the buttons that come by default offer to upload a chart
const buttons = [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
const config = { responsive: true, displaylogo: false, modeBarButtons: buttons };
const figures = JSON.parse(document.getElementById("figures").textContent);
for (const figure of figures) {
  Plotly.newPlot(figure.id, figure.data, figure.layout, config);
}
// paper has another width than the screen, and nothing else tells the charts
const fit = () => figures.forEach((figure) => Plotly.Plots.resize(figure.id));
addEventListener("beforeprint", fit);
addEventListener("afterprint", fit);
