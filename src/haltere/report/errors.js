// First of all scripts: what goes wrong in the page is kept where it can be read.
(() => {
  "use strict";
  const found = [];
  window.haltereFailed = (what) => {
    found.push(String(what && what.message ? what.message : what));
    document.documentElement.dataset.errors = JSON.stringify(found);
    const box = document.getElementById("trouble");
    if (box) {
      box.hidden = false;
      box.textContent = "Something in this page did not work: " + found.join("; ");
    }
  };
  document.documentElement.dataset.errors = "[]";
  addEventListener("error", (e) => window.haltereFailed(e.message || "a script failed"));
  addEventListener("unhandledrejection", (e) => window.haltereFailed(e.reason));
  addEventListener("securitypolicyviolation", (e) => window.haltereFailed("refused to load " + e.blockedURI));
})();
