/** Stillpath in OctoPrint's page: the list of files on their way, settings, buttons of files. */
$(function () {
    function StillpathViewModel(parameters) {
        var self = this;

        self.loginState = parameters[0];
        self.access = parameters[1];
        self.settings = parameters[2];
        self.files = parameters[3];

        self.entries = ko.observableArray([]);
        self.machines = ko.observableArray([]);
        self.answer = ko.observable("");
        self.unseen = ko.observable(0);

        self.working = ko.pureComputed(function () {
            return self.entries().filter(function (entry) {
                return !entry.is_over;
            });
        });
        self.navbar = ko.pureComputed(function () {
            var entry = self.working().slice(-1)[0];
            return entry ? self.percent(entry) || "\u2026" : "";
        });
        self.mayProcess = ko.pureComputed(function () {
            return self.loginState.hasPermission(self.access.permissions.FILES_UPLOAD);
        });

        self.percent = function (entry) {
            return entry.progress === null ? "" : Math.floor(100 * entry.progress) + " %";
        };
        self.stage = function (entry) {
            return entry.stage || gettext("waiting");
        };
        self.sentence = function (entry) {
            var text = entry.state === "cancelled" ? gettext("cancelled") : entry.message;
            if (entry.state === "done" && entry.not_printed) {
                text += " \u2013 " + gettext("not printed") + ": " + entry.not_printed;
            }
            return text;
        };
        self.report = function (id) {
            return BASEURL + "plugin/stillpath/reports/" + encodeURIComponent(id);
        };
        self.seen = function () {
            self.unseen(0);
            return true;
        };

        // Every failure is shown: these requests are answered with their reason.
        self.ask = function (command, data) {
            return OctoPrint.simpleApiCommand("stillpath", command, data).fail(function (answer) {
                var problem = answer.responseJSON || {};
                self.notify("error", problem.error || answer.statusText || "");
            });
        };
        self.process = function (file) {
            self.ask("process", {path: file.path}).done(self.request);
        };
        self.again = function (entry) {
            self.process(entry);
        };
        self.cancel = function (entry) {
            self.ask("cancel", {id: entry.id});
        };
        self.forget = function () {
            self.ask("forget", {}).done(self.take);
        };
        self.request = function () {
            if (self.loginState.hasPermission(self.access.permissions.FILES_LIST)) {
                OctoPrint.simpleApiGet("stillpath").done(self.take);
            }
        };
        self.take = function (answer) {
            if (answer && answer.entries) {
                self.entries(answer.entries);
            }
        };
        self.notify = function (type, text) {
            new PNotify({
                title: "Stillpath",
                text: _.escape(text),
                type: type,
                hide: type !== "error",
                buttons: {sticker: false, closer: true}
            });
        };

        self.onUserLoggedIn = self.onUserLoggedOut = self.onServerReconnect = self.request;
        self.onStartupComplete = self.request;
        self.onDataUpdaterPluginMessage = function (plugin, message) {
            if (plugin !== "stillpath") {
                return;
            }
            self.take(message);
            var ended = message.ended;
            if (ended && ended.state === "done") {
                self.notify("success", ended.path + ": " + self.sentence(ended));
            } else if (ended && ended.state === "failed") {
                self.unseen(self.unseen() + 1);
                self.notify(
                    "error",
                    ended.path + " " + gettext("is not compensated") + ": " + ended.message
                );
            }
        };

        // Settings

        self.mine = function () {
            return self.settings.settings.plugins.stillpath;
        };
        self.addMachine = function () {
            self.mine().machines.push({profile: ko.observable(""), machine: ko.observable("")});
        };
        self.removeMachine = function (row) {
            self.mine().machines.remove(row);
        };
        self.look = function () {
            self.answer(gettext("asking") + " \u2026");
            self.ask("machines", {server: self.mine().server(), key: self.mine().key()})
                .done(function (found) {
                    self.machines(found.machines);
                    self.answer(
                        found.reason || found.machines.length + " " + gettext("machines found")
                    );
                })
                .fail(function () {
                    self.answer("");
                });
        };

        // Buttons in the list of files: of the original to start, of the result to its report.

        self.ours = function (file) {
            return (file && file.stillpath) || {};
        };
        self.files.stillpath = self;
    }

    var buttons =
        '<div class="btn btn-mini btn-files-stillpath" role="link" title="Stillpath" ' +
        'aria-label="Stillpath" data-bind="visible: origin === \'local\' && ' +
        '$root.stillpath.mayProcess() && !$root.stillpath.ours($data).source, ' +
        'click: function() { $root.stillpath.process($data); }">' +
        '<i class="fas fa-bezier-curve"></i></div>' +
        '<a class="btn btn-mini btn-files-stillpath-report" target="_blank" rel="noopener" ' +
        'title="Report of Stillpath" aria-label="Report of Stillpath" data-bind="' +
        "visible: $root.stillpath.ours($data).report, " +
        "attr: {href: $root.stillpath.report($root.stillpath.ours($data).report || '')}\">" +
        '<i class="fas fa-chart-line"></i></a>';
    var template = $("#files_template_machinecode");
    template.text(
        template.text().replace(/(<div class="btn-group action-buttons">)/, "$1" + buttons)
    );

    OCTOPRINT_VIEWMODELS.push({
        construct: StillpathViewModel,
        dependencies: [
            "loginStateViewModel",
            "accessViewModel",
            "settingsViewModel",
            "filesViewModel"
        ],
        elements: [
            "#navbar_plugin_stillpath",
            "#sidebar_plugin_stillpath_wrapper",
            "#settings_plugin_stillpath"
        ]
    });
});
